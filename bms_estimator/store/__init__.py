"""SQLite storage: outbox, history, one-minute rows, migrations."""
