"""What all tasks share: protocol, episodes, the TorchRL environment."""
