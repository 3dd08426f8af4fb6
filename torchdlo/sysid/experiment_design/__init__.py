"""Design of the experiment that tells competing models apart."""
