"""From many frames to rows of a database."""
