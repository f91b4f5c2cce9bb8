// Partial sums, added up in their order whatever the number of threads.
constexpr int64_t kSpan = 4096;  // elements of a task

template <class T>
void clear_partials(const Executor& executor, T* partials, int64_t count, int64_t elements) {
  const int64_t all = count * elements, tasks = (all + kSpan - 1) / kSpan;
  run_tasks(executor, tasks, workers_for(executor, tasks, all / 4), [&](int, int64_t task) {
    const int64_t begin = task * kSpan;
    std::fill_n(partials + begin, std::min(kSpan, all - begin), T(0));
  });
}

// Into the first.
template <class T>
void add_partials(const Executor& executor, T* partials, int64_t count, int64_t elements) {
  const int64_t tasks = count > 1 ? (elements + kSpan - 1) / kSpan : 0;
  run_tasks(executor, tasks, workers_for(executor, tasks, count * elements / 4),
            [&](int, int64_t task) {
              const int64_t begin = task * kSpan, end = std::min(elements, begin + kSpan);
              for (int64_t k = 1; k < count; ++k) {
                const T* from = partials + k * elements;
                for (int64_t i = begin; i < end; ++i) partials[i] += from[i];
              }
            });
}
