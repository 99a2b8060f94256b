// What stands around the engine's work when Python calls it.
#pragma once

#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

#include "system.hpp"

namespace eip {

// Subnormal numbers are numbers here, whatever another library left in the processor's mode.
class FloatingPoint {
  public:
#if defined(__SSE2__)
    FloatingPoint() : mode_(_mm_getcsr()) { _mm_setcsr(mode_ & ~0x8040u); }
    ~FloatingPoint() { _mm_setcsr(mode_); }

  private:
    unsigned mode_;
#endif
};

// The Python error of a call that was `Broken`, but where one is set already.
void raise_broken(const System &system);

}  // namespace eip
