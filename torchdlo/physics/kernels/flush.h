// Numbers too small to be normal ones count as zero while this lives, in its thread: they take a hundred times as long.
#pragma once
#if defined(__SSE__)
#include <xmmintrin.h>
struct FlushTiny {
  const unsigned before = _mm_getcsr();
  FlushTiny() { _mm_setcsr(before | 0x8040); }  // results and inputs
  ~FlushTiny() { _mm_setcsr(before); }
};
#elif defined(__aarch64__)
#include <cstdint>
struct FlushTiny {
  uint64_t before;
  FlushTiny() {
    asm volatile("mrs %0, fpcr" : "=r"(before));
    asm volatile("msr fpcr, %0" : : "r"(before | (uint64_t(1) << 24)));
  }
  ~FlushTiny() { asm volatile("msr fpcr, %0" : : "r"(before)); }
};
#else
struct FlushTiny {
  FlushTiny() {}
  ~FlushTiny() {}
};
#endif
