"""The lens, from pictures of a board."""
