"""Where samples come from: serial boards, captures, tables, the virtual board."""
