"""What several couplings share."""
