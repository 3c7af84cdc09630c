"""Table ``[source]`` of the settings file, one file for each kind of source."""
