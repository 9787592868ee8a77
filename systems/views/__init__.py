"""Views and buttons in Meshcat; contact_probe gives true contact forces for scores."""
