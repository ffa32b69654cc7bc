// Memory that is kept from one use to the next, so that a training step neither asks for pages nor clears them.
#pragma once

#include <cstddef>
#include <memory>
#include <mutex>
#include <new>
#include <vector>

namespace rf3dgs {

// An array of plain values aligned to cache lines. Growing it loses what it held; new values are not initialised.
template <class T>
class Buffer {
 public:
  T* resize(size_t count) {
    if (count > capacity_) {
      capacity_ = 0;
      memory_.reset();
      const size_t wanted = count + count / 4;
      memory_.reset(static_cast<T*>(::operator new(wanted * sizeof(T), kAlignment)));
      capacity_ = wanted;
    }
    count_ = count;
    return memory_.get();
  }

  // Room for `count` values of which the first `kept` stay.
  T* grow(size_t count, size_t kept) {
    if (count > capacity_) {
      Buffer larger;
      larger.resize(count + count / 2);
      for (size_t at = 0; at < kept; ++at) larger[at] = memory_.get()[at];
      *this = std::move(larger);
    }
    count_ = count;
    return memory_.get();
  }

  T* data() { return memory_.get(); }
  const T* data() const { return memory_.get(); }
  size_t size() const { return count_; }
  T& operator[](size_t at) { return memory_.get()[at]; }
  const T& operator[](size_t at) const { return memory_.get()[at]; }

 private:
  static constexpr std::align_val_t kAlignment{64};
  struct Release {
    void operator()(T* memory) const { ::operator delete(memory, kAlignment); }
  };
  std::unique_ptr<T, Release> memory_;
  size_t count_ = 0, capacity_ = 0;
};

// A T for as long as this lives; the last few that were given back are handed out again. A fork may leave the lock of
// the store taken for ever, so nobody waits for it.
template <class T>
class Recycled {
 public:
  Recycled() {
    std::unique_lock<std::mutex> lock(mutex(), std::try_to_lock);
    if (lock.owns_lock() && !store().empty()) {
      object_ = std::move(store().back());
      store().pop_back();
    }
    if (object_ == nullptr) object_ = std::make_unique<T>();
  }
  ~Recycled() {
    std::unique_lock<std::mutex> lock(mutex(), std::try_to_lock);
    if (lock.owns_lock() && store().size() < kKept) store().push_back(std::move(object_));
  }
  Recycled(const Recycled&) = delete;
  Recycled& operator=(const Recycled&) = delete;

  T* operator->() { return object_.get(); }
  const T* operator->() const { return object_.get(); }
  T& operator*() { return *object_; }
  const T& operator*() const { return *object_; }

 private:
  static constexpr size_t kKept = 2;
  // Never destroyed: scenes may outlive static objects when the interpreter ends.
  static std::mutex& mutex() {
    static std::mutex& mutex = *new std::mutex;
    return mutex;
  }
  static std::vector<std::unique_ptr<T>>& store() {
    static std::vector<std::unique_ptr<T>>& store = *new std::vector<std::unique_ptr<T>>;
    return store;
  }
  std::unique_ptr<T> object_;
};

}  // namespace rf3dgs
