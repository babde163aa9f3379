"""Height above the ground: elevation models, profiles of ways over them, and limits of climb."""
