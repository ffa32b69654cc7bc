"""Constants of the rasterizer, the same as in the native core's header."""

ALPHA_MAX = 0.99  # no Gaussian hides more than this of what lies behind it
ALPHA_MIN = 1.0 / 255.0  # weaker contributions to a pixel are skipped
TRANSMITTANCE_STOP = 1e-4  # a pixel stops before the contribution that would bring its transmittance below this
BLUR = 0.3  # added to both variances of a projected Gaussian [pixel^2]
NEAR = 0.05  # Gaussians nearer than this view depth are not drawn [m]
FIELD_CLAMP = 1.3  # the Jacobian's x/z and y/z stay within this many half-fields from the principal point
GATE_TRANSMITTANCE = 0.75  # the depth gate counts from the Gaussian that brings a pixel below this
SPHERE_FIELD = 0.2  # a panorama shows a Gaussian where the cosine of the angle to its centre exceeds this

SSIM_RADIUS = 5  # the window of the structural similarity is 11x11 pixels
SSIM_SIGMA = 1.5  # its standard deviation [pixel]
SSIM_C1 = 0.01**2  # keeps dark windows stable
SSIM_C2 = 0.03**2  # keeps flat windows stable
