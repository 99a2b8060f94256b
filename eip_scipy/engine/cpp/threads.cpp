// The pool has one thread less than OMP_NUM_THREADS, or than the processors that this process may use. It is made by the first
// call, and again in a forked process, which has only the thread that forked. Without OMP_NUM_THREADS a forked process works
// with one thread: most probably there are as many of them as processors. The threads wait actively for a short time, because a
// run evaluates the next sum soon, and then sleep. Active threads yield, so that they take no time from other programs.
#include "threads.hpp"

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>
#if !defined(_WIN32)
#include <unistd.h>
#endif
#if defined(__linux__)
#include <sched.h>
#endif

#include "calls.hpp"

namespace eip {
namespace {

constexpr int MOST_THREADS = 16;  // the sums have no more parts
constexpr std::chrono::microseconds ACTIVE{50};
using Clock = std::chrono::steady_clock;

int64_t process() {
#if defined(_WIN32)
    return 0;  // processes are never forked
#else
    return getpid();
#endif
}

const int64_t first_process = process();

int processors() {
    const char *given = std::getenv("OMP_NUM_THREADS");
    if (const int threads = given ? std::atoi(given) : 0; threads > 0) return threads;
    if (process() != first_process) return 1;
#if defined(__linux__)
    cpu_set_t usable;
    if (sched_getaffinity(0, sizeof usable, &usable) == 0) return CPU_COUNT(&usable);
#endif
    return static_cast<int>(std::thread::hardware_concurrency());
}

class Pool {
  public:
    const int64_t owner = process();

    // False if the pool works for another caller, or has no threads.
    bool run(int64_t parts, void (*part)(const void *, int64_t), const void *context) {
        const std::unique_lock<std::mutex> lock(serving_, std::try_to_lock);
        if (!lock || ended_) return false;
        if (!started_) start();
        if (threads_.empty()) return false;
        part_ = part;
        context_ = context;
        unfinished_ = parts;
        left_ = ((left_ >> 32) + 1) << 32 | static_cast<uint64_t>(parts);
        if (sleepers_ > 0) {
            const std::lock_guard<std::mutex> before_they_look(sleeping_);
            awake_.notify_all();
        }
        while (take()) continue;
        while (unfinished_.load(std::memory_order_acquire) > 0) std::this_thread::yield();
        return true;
    }

    void end() {
        const std::lock_guard<std::mutex> lock(serving_);
        sleeping_.lock();
        ended_ = true;
        sleeping_.unlock();
        awake_.notify_all();
        for (std::thread &thread : threads_) thread.join();
        threads_.clear();
    }

  private:
    void start() {
        started_ = true;
        try {
            for (int k = 1; k < std::min(processors(), MOST_THREADS); ++k) threads_.emplace_back([this] { work(); });
        } catch (const std::system_error &) {  // fewer threads do as well
        }
    }

    // Take and do one part. The job cannot end, nor the next one begin, until that part is done.
    bool take() {
        uint64_t left = left_;
        while (static_cast<uint32_t>(left) > 0)
            if (left_.compare_exchange_weak(left, left - 1)) {
                part_(context_, static_cast<uint32_t>(left) - 1);
                unfinished_.fetch_sub(1, std::memory_order_release);
                return true;
            }
        return false;
    }

    void work() {
        const FloatingPoint mode;
        while (!ended_) {
            for (auto until = Clock::now() + ACTIVE; !ended_ && Clock::now() < until; std::this_thread::yield())
                if (take()) until = Clock::now() + ACTIVE;
            std::unique_lock<std::mutex> lock(sleeping_);
            ++sleepers_;
            awake_.wait(lock, [this] { return ended_ || static_cast<uint32_t>(left_) > 0; });
            --sleepers_;
        }
    }

    std::mutex serving_, sleeping_;
    std::condition_variable awake_;
    std::vector<std::thread> threads_;
    bool started_ = false;
    std::atomic<bool> ended_ = false;
    std::atomic<int> sleepers_ = 0;
    std::atomic<uint64_t> left_ =
        0;  // upper half: the job's number; lower half: how many of its parts nobody has taken
    std::atomic<int64_t> unfinished_ = 0;
    void (*part_)(const void *, int64_t) = nullptr;
    const void *context_ = nullptr;
};

// Never deleted: a thread may still use it while the process ends, and the threads of a forked process do not exist.
std::atomic<Pool *> current = nullptr;

Pool &pool() {
    Pool *found = current;
    if (found && found->owner == process()) return *found;
    Pool *made = new Pool;
    if (current.compare_exchange_strong(found, made)) return *made;
    delete made;
    return *found;
}

thread_local bool alone = false;

}  // namespace

void share(int64_t parts, void (*part)(const void *context, int64_t k), const void *context) {
    if (!alone && parts > 1 && pool().run(parts, part, context)) return;
    for (int64_t k = parts - 1; k >= 0; --k) part(context, k);
}

bool work_alone(bool value) { return std::exchange(alone, value); }

void end_threads() { pool().end(); }

}  // namespace eip
