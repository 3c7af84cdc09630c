"""Hourly Parquet files and DuckDB queries on them."""
