"""Kinds of data as problems for the search: what effects leave of them unexplained."""
