"""What several stages use and none of them owns: how they hand their arrays to kernels. No file here is a stage."""
