"""The ways to draw Gaussians: the native core on the CPU, gsplat on CUDA; the specification is `splats.reference`."""
