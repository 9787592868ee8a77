"""Other people's answers, to compare with."""
