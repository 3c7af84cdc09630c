"""From captures to cell models: relaxation test, OCV, series resistance, identification, validation."""
