"""What the commands run that take pictures, points and pixels."""
