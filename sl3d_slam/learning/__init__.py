"""How the line network comes to its weights: data, losses, training."""
