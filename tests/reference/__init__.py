"""An independent float64 reference of the equations of motion, written from the textbook's matrices.

Nothing here is taken from `finssim.physics`: Coriolis matrices are built as matrices (Fossen 2021, section 3.3), points
are changed with transformation matrices, waves come from their potential, and a hull is cut triangle by triangle by
sorting its corners. All functions are NumPy over a leading `...` batch.
"""
