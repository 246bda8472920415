"""The pose of a design, found on pixels."""
