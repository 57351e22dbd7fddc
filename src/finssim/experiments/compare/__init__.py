"""`finssim compare`: what trainings over seeds are worth, beside each other."""
