"""What a synthetic set or a suite is a function of."""
