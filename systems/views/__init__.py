"""What is seen in Meshcat and pressed there, and contact_probe's truth for scores."""
