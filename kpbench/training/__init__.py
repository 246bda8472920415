"""How the weights are made: of the network and of its verifier."""
