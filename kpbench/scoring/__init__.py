"""Truth and detections become numbers; nothing here reads a file."""
