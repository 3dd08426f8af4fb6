"""What environments see besides numbers: cameras of tasks, and pictures, depths, masks and points from them."""
