"""The maths of the baselines: other people's answers, to compare with."""
