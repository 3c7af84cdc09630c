"""Tables of samples: text, spreadsheets, Parquet and binary files of cyclers, recognized by their columns."""
