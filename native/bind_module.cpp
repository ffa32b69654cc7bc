#include <nanobind/nanobind.h>

namespace nb = nanobind;

NB_MODULE(_native, m) {
  m.doc() = "The native core of rf3dgs.";
  m.def("info", [] { return nb::dict(); });
}
