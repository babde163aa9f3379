"""Work on the ground: prime, flush, rinse, catch, click. A pure step, and the shell around it."""
