"""Descriptors on disk: the database, its index, selection, and other forms of it."""
