"""Commands that write cell files."""
