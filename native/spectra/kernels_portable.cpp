#include "spectra/kernels_spread.hpp"

RF3DGS_DEFINE_SPECTRA(portable_spectra)
