"""What the programs of this folder share. They need the package without torch."""
