"""Methods of other authors for comparison; and Frozen, for ablations."""
