"""What environments see besides numbers: cameras of tasks, and the pictures, depths, masks and points that they
give."""
