"""The commands of ``ssrvlad``, one a file, and what they share."""
