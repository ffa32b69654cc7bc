#pragma once

#include <nanobind/nanobind.h>

void bind_spectra(nanobind::module_& m);
