"""Files and pictures of what was found."""
