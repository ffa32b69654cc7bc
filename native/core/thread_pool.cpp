#include "core/thread_pool.hpp"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace rf3dgs {
namespace {

constexpr int kSpins = 500;  // some ten microseconds

inline void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#endif
}

class Pool {
 public:
  void run(int count, int threads, const Work& work) {
    std::lock_guard<std::mutex> one_loop_at_a_time(loop_mutex_);
    const int helpers = std::min(threads, count) - 1;
    while (static_cast<int>(workers_.size()) < helpers) {
      const int rank = static_cast<int>(workers_.size());
      const unsigned seen = generation_.load(std::memory_order_relaxed);
      workers_.emplace_back([this, rank, seen] { wait_for_loops(rank, seen); });
    }
    work_ = &work;
    count_ = count;
    helpers_ = helpers;
    failure_ = nullptr;
    next_.store(0, std::memory_order_relaxed);
    open_.store(true);
    {
      std::lock_guard<std::mutex> lock(sleep_mutex_);
      generation_.fetch_add(1, std::memory_order_release);
    }
    wake_.notify_all();
    take_turns();
    open_.store(false);
    wait_for_helpers();
    if (failure_) std::rethrow_exception(failure_);
  }

 private:
  void take_turns() {
    try {
      for (int index = next_.fetch_add(1); index < count_; index = next_.fetch_add(1)) (*work_)(index);
    } catch (...) {
      next_.store(count_);
      std::lock_guard<std::mutex> lock(sleep_mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }

  // A worker counts itself in before it looks whether a loop is open, and the loop is closed before its caller waits for
  // nobody to be inside: so a worker touches a loop only while its caller waits, and a worker that wakes late is not
  // waited for.
  void wait_for_loops(int rank, unsigned seen) {
    for (;;) {
      for (int spins = 0; generation_.load(std::memory_order_acquire) == seen && spins < kSpins; ++spins) relax();
      if (generation_.load(std::memory_order_acquire) == seen) {
        std::unique_lock<std::mutex> lock(sleep_mutex_);
        wake_.wait(lock, [&] { return generation_.load(std::memory_order_relaxed) != seen; });
      }
      seen = generation_.load(std::memory_order_acquire);
      inside_.fetch_add(1);
      if (open_.load() && rank < helpers_) take_turns();
      if (inside_.fetch_sub(1) == 1 && !open_.load()) {
        std::lock_guard<std::mutex> lock(sleep_mutex_);
        done_.notify_one();
      }
    }
  }

  void wait_for_helpers() {
    for (int spins = 0; spins < kSpins; ++spins) {
      if (inside_.load() == 0) return;
      relax();
    }
    std::unique_lock<std::mutex> lock(sleep_mutex_);
    done_.wait(lock, [&] { return inside_.load() == 0; });
  }

  std::mutex loop_mutex_;
  std::mutex sleep_mutex_;
  std::condition_variable wake_;
  std::condition_variable done_;
  std::vector<std::thread> workers_;
  std::atomic<unsigned> generation_{0};
  std::atomic<bool> open_{false};
  std::atomic<int> inside_{0};  // workers
  std::atomic<int> next_{0};
  const Work* work_ = nullptr;
  int count_ = 0;
  int helpers_ = 0;
  std::exception_ptr failure_;
};

// The pool of a parent process is left alone after a fork: its threads do not exist in the child. Pools are never
// destroyed, because a thread that waits at exit has nobody to wake it.
Pool& pool_of_this_process() {
  static std::atomic<Pool*> pool{nullptr};
  static std::atomic<pid_t> owner{0};
  static std::atomic_flag starting = ATOMIC_FLAG_INIT;
  if (owner.load(std::memory_order_acquire) != getpid()) {
    while (starting.test_and_set(std::memory_order_acquire)) std::this_thread::yield();
    if (owner.load(std::memory_order_relaxed) != getpid()) {
      pool.store(new Pool, std::memory_order_relaxed);
      owner.store(getpid(), std::memory_order_release);
    }
    starting.clear(std::memory_order_release);
  }
  return *pool.load(std::memory_order_acquire);
}

}  // namespace

void parallel_for(int count, int threads, const Work& work) {
  if (threads <= 1 || count <= 1) {
    for (int index = 0; index < count; ++index) work(index);
    return;
  }
  pool_of_this_process().run(count, threads, work);
}

}  // namespace rf3dgs
