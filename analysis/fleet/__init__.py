"""Many journals as one data set: added, asked by SQL, reported, served."""
