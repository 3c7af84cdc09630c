"""Where estimates go: MQTT, the console, CSV and Parquet files."""
