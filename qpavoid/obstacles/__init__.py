"""Obstacles at run time: where they are, how they move, what is known of them, and who carries them."""
