"""What is printed: designs of patches, boards of patches, boards of tags."""
