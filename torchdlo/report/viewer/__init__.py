"""Interactive view in the browser."""
