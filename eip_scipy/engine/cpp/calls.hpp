// What stands around the engine's work when Python calls it.
#pragma once

#include "system.hpp"

namespace eip {

// Subnormal numbers are numbers here, whatever another library left in the processor's mode.
class [[maybe_unused]] FloatingPoint {
  public:
#if defined(__SSE2__)
    FloatingPoint() : mode_(__builtin_ia32_stmxcsr()) { __builtin_ia32_ldmxcsr(mode_ & ~0x8040u); }
    ~FloatingPoint() { __builtin_ia32_ldmxcsr(mode_); }

  private:
    unsigned mode_;
#endif
};

// The Python error of a call that was `Broken`, but where one is set already.
[[noreturn]] void raise_broken(const System &system);

}  // namespace eip
