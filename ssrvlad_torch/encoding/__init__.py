"""Many frames -> database."""
