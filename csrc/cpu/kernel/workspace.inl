// Uninitialised memory of a call.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(int64_t count) : block_(take_block(static_cast<size_t>(count) * sizeof(T))) {}
  Buffer(Buffer&& other) noexcept : block_(std::exchange(other.block_, {})) {}
  Buffer& operator=(Buffer&& other) noexcept {
    std::swap(block_, other.block_);
    return *this;
  }
  ~Buffer() { return_block(block_); }

  T* get() const { return static_cast<T*>(block_.data); }
  explicit operator bool() const { return block_.data != nullptr; }

 private:
  Block block_;
};

// Scratch, one buffer cut into 64-byte aligned pieces.
class Workspace {
 public:
  explicit Workspace(int64_t bytes) : memory_(bytes), next_(memory_.get()) {}
  template <class U>
  static int64_t need(int64_t count) {
    return round_up(count * static_cast<int64_t>(sizeof(U)), 64);
  }
  template <class U>
  U* take(int64_t count) {
    U* piece = reinterpret_cast<U*>(next_);
    next_ += need<U>(count);
    return piece;
  }

 private:
  Buffer<char> memory_;
  char* next_;
};

// Hands task numbers to the workers, many at first, for neighbours share what they read and write,
// then fewer, so that all end together. Which worker runs a task changes no result.
template <class Body>
void run_tasks(const Executor& executor, int64_t tasks, int workers, const Body& body) {
  struct Queue {
    std::atomic<int64_t> next{0};
    int64_t tasks, shares;
    const Body* body;
  } queue;
  queue.tasks = tasks;
  queue.shares = int64_t{4} * workers;  // of what is left
  queue.body = &body;
  executor.run(
      workers,
      [](void* context, int worker) {
        Queue& shared = *static_cast<Queue*>(context);
        const int64_t tasks = shared.tasks;
        for (int64_t task = shared.next.load(); task < tasks;) {
          const int64_t end = task + std::max<int64_t>(1, (tasks - task) / shared.shares);
          if (!shared.next.compare_exchange_weak(task, end)) continue;
          for (; task < end; ++task) (*shared.body)(worker, task);
          task = shared.next.load();
        }
      },
      &queue);
}

// work: rough number of multiply-adds or element moves; below a threshold threads cost more.
SURFCONV_INLINE int workers_for(const Executor& executor, int64_t tasks, int64_t work) {
  constexpr int64_t kWorkPerThread = 40000;
  const int64_t useful = std::min(tasks, work / kWorkPerThread + 1);
  return static_cast<int>(std::max<int64_t>(1, std::min<int64_t>(executor.threads, useful)));
}

// Between two objects, which plain pointer arithmetic does not cover.
SURFCONV_INLINE int64_t byte_distance(const void* from, const void* to) {
  return static_cast<int64_t>(reinterpret_cast<uintptr_t>(to) - reinterpret_cast<uintptr_t>(from));
}
