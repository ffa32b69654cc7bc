#pragma once

#include <nanobind/nanobind.h>

void bind_floor(nanobind::module_& m);
