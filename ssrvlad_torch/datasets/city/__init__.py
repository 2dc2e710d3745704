"""The parts of the synthetic city: conditions, streets, blocks, traffic, and the rendering."""
