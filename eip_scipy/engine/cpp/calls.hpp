// Set-up and error handling around each call of the engine from Python.
#pragma once

#include <cstdint>

namespace eip {

struct System;

// The mode of the processor's floating-point unit, and the bits that have it take or leave subnormal numbers as zero.
#if defined(__SSE2__)
using Mode = unsigned;
constexpr Mode FLUSHING = 0x8040u;  // FTZ and DAZ of MXCSR
inline Mode read_mode() { return __builtin_ia32_stmxcsr(); }
inline void write_mode(Mode mode) { __builtin_ia32_ldmxcsr(mode); }
#elif defined(__aarch64__)
using Mode = uint64_t;
constexpr Mode FLUSHING = 0x1000001u;  // FZ and FIZ of FPCR
inline Mode read_mode() {
    Mode mode;
    __asm__ volatile("mrs %0, fpcr" : "=r"(mode));
    return mode;
}
inline void write_mode(Mode mode) { __asm__ volatile("msr fpcr, %0" : : "r"(mode)); }
#else
using Mode = unsigned;
constexpr Mode FLUSHING = 0u;
inline Mode read_mode() { return 0u; }
inline void write_mode(Mode) {}
#endif

// Subnormal numbers are numbers here, whatever another library left in the processor's mode.
class [[maybe_unused]] FloatingPoint {
  public:
    FloatingPoint() : mode_(read_mode()) {
        if (mode_ & FLUSHING) write_mode(mode_ & ~FLUSHING);
    }
    ~FloatingPoint() {
        if (mode_ & FLUSHING) write_mode(mode_);
    }
    FloatingPoint(const FloatingPoint &) = delete;
    FloatingPoint &operator=(const FloatingPoint &) = delete;

  private:
    Mode mode_;
};

// Raises the Python error for a user's function that failed (`Broken`); an error that is already set is kept.
[[noreturn]] void raise_broken(const System &system);

}  // namespace eip
