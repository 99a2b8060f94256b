/* Preloaded by test_failing_memory.py: C++'s operator new, whose n-th call after arm(n) fails. */
#include <stdlib.h>

extern void _ZSt17__throw_bad_allocv(void); /* std::__throw_bad_alloc() */

static long left, calls;

/* Let the n-th call from now on fail; 0: none. Returns the number of calls since it was last called. */
long arm(long n)
{
    long seen = calls;
    left = n;
    calls = 0;
    return seen;
}

static void *allocate(size_t size, size_t alignment)
{
    void *found = 0;
    ++calls;
    if (left > 0 && --left == 0)
        _ZSt17__throw_bad_allocv();
    if (posix_memalign(&found, alignment < 16 ? 16 : alignment, size ? size : 1))
        _ZSt17__throw_bad_allocv();
    return found;
}

void *_Znwm(size_t size) { return allocate(size, 16); }
void *_Znam(size_t size) { return allocate(size, 16); }
void *_ZnwmSt11align_val_t(size_t size, size_t alignment) { return allocate(size, alignment); }
void *_ZnamSt11align_val_t(size_t size, size_t alignment) { return allocate(size, alignment); }
