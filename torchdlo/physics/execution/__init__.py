"""How steps run: replayed for gradients, or traced."""
