"""3D Gaussian Splatting on any OpenCL device, without CUDA and without torch."""
