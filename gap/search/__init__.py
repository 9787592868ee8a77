"""Which effects a scene lacks: screened, selected, fitted, and what to trust."""
