"""Many frames -> database, and the search with them."""
