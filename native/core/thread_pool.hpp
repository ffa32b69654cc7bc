// A pool of threads that share one loop at a time.
//
// `parallel_for(count, threads, work)` calls work(index) once for every index below `count`. Which thread takes which
// index is left to chance, so work(i) writes only where no other index writes; results then cannot depend on the number
// of threads. Workers spin for some microseconds after a loop and then sleep. A forked child starts a pool of its own.
#pragma once

#include <functional>

namespace rf3dgs {

using Work = std::function<void(int)>;

void parallel_for(int count, int threads, const Work& work);

}  // namespace rf3dgs
