"""Functions that several stages use to hand their arrays to kernels. No file here is a stage."""
