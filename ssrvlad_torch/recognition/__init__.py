"""From descriptors to places."""
