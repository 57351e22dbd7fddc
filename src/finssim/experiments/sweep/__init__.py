"""`finssim sweep`: many trainings over settings and seeds, on one machine or many."""
