"""Commands on captures."""
