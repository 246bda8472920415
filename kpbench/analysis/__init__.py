"""How good a design is, the search for better ones, and its figure."""
