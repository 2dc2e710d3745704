"""What a `Database` is on the disk: Parquet parts and a manifest."""
