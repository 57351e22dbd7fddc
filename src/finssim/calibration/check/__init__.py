"""What trials can and cannot tell, and what is wrong with them."""
