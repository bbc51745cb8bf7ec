"""magmav."""
