"""The dataset folder: shards and manifest, reading, making, exporting."""
