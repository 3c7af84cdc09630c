"""Setup of a pack: search of the device, questions, comparison with a multimeter, settings file, first estimate."""
