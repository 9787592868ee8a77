"""Other people's answers, to compare with; and frozen, a system that does nothing."""
