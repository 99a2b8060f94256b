// Threads that share one long loop among themselves, such as the sums over the pairs of many bodies.
#pragma once

#include <cstdint>

namespace eip {

// Calls part(context, k) for every k < parts, the last k first, and returns when all calls have returned. The threads of a
// pool take parts as well, unless they work for another caller: then the caller does everything. A part must not throw.
void share(int64_t parts, void (*part)(const void *context, int64_t k), const void *context);

template <class Part>
inline void share(int64_t parts, const Part &part) {
    share(parts, [](const void *context, int64_t k) { (*static_cast<const Part *>(context))(k); }, &part);
}

// Keeps the calling thread from using the pool, or lets it use the pool again. Returns what was set before.
bool work_alone(bool alone);

// Ends the threads of the pool for good, at the end of the process.
void end_threads();

}  // namespace eip
