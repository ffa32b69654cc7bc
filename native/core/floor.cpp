#include "core/floor.hpp"

#include <time.h>

#include <algorithm>
#include <barrier>
#include <chrono>
#include <functional>
#include <memory>
#include <numeric>
#include <thread>
#include <vector>

namespace rf3dgs {
namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

double thread_cpu_seconds() {
  timespec now;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

// Threads of their own, one for each rank: a shared pool might give two ranks to one thread.
void on_threads(int threads, const std::function<void(int)>& work) {
  std::vector<std::thread> running;
  for (int rank = 0; rank < threads; ++rank) running.emplace_back(work, rank);
  for (std::thread& thread : running) thread.join();
}

}  // namespace

double multiply_add_rate(const FloorKernels& kernels, int threads, double seconds) {
  constexpr size_t kRounds = 200'000;
  std::vector<double> best(threads, 0.0);
  std::barrier together(threads);
  on_threads(threads, [&](int rank) {
    together.arrive_and_wait();
    float sink = 0.0f;
    const Clock::time_point start = Clock::now();
    do {
      const double before = thread_cpu_seconds();
      const size_t done = kernels.multiply_adds(kRounds, &sink);
      best[rank] = std::max(best[rank], static_cast<double>(done) / (thread_cpu_seconds() - before));
    } while (seconds_since(start) < seconds);
  });
  return std::accumulate(best.begin(), best.end(), 0.0) / threads;
}

double bandwidth(const FloorKernels& kernels, Traffic traffic, int threads, size_t bytes, double seconds) {
  const size_t count = std::max<size_t>(bytes / sizeof(float) / threads, 1024);
  const double moved = static_cast<double>(count * sizeof(float)) * (traffic == Traffic::change ? 2.0 : 1.0);
  std::vector<double> best(threads, 0.0);
  std::barrier together(threads);
  on_threads(threads, [&](int rank) {
    const std::unique_ptr<float[]> share(new float[count]());
    float sink = 0.0f;
    together.arrive_and_wait();
    const Clock::time_point start = Clock::now();
    do {
      const double before = thread_cpu_seconds();
      if (traffic == Traffic::read) kernels.read_all(share.get(), count, &sink);
      if (traffic == Traffic::change) kernels.change_all(share.get(), count);
      best[rank] = std::max(best[rank], moved / (thread_cpu_seconds() - before));
    } while (seconds_since(start) < seconds);
  });
  return std::accumulate(best.begin(), best.end(), 0.0);
}

}  // namespace rf3dgs
