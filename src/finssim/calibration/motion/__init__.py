"""From a trial's streams to velocities, accelerations and attitude on one grid."""
