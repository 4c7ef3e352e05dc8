/* The instruction set of the processor, the compiler of this library, and the handling of denormal numbers in a thread. The
 * first function is compiled for any x86-64, so that every processor can call it in the library for the lowest level. */
#include "vector.h"

/* 4, 3 or 2 for x86-64-v4 (AVX-512), x86-64-v3 (AVX2, FMA) or x86-64-v2 (SSE4.2), 0 for less; 8 for ARMv8. */
#ifdef __x86_64__
__attribute__((target("arch=x86-64"))) int rosafe_processor_level(void) {
    __builtin_cpu_init();
#define HAS __builtin_cpu_supports /* clang does not know the levels' names yet */
    if (!HAS("sse4.2") || !HAS("ssse3") || !HAS("popcnt")) return 0;
    if (!HAS("avx2") || !HAS("fma") || !HAS("bmi") || !HAS("bmi2")) return 2;
    return HAS("avx512f") && HAS("avx512bw") && HAS("avx512cd") && HAS("avx512dq") && HAS("avx512vl") ? 4 : 3;
}
#else
int rosafe_processor_level(void) { return 8; }
#endif

const char *rosafe_compiler(void) {
#ifdef __clang__
    return "clang " __clang_version__;
#else
    return "gcc " __VERSION__;
#endif
}

/* For code outside of kernels; returns the argument for rosafe_denormals_as. */
uint32_t rosafe_denormals_off(void) { return denormals_off(); }
void rosafe_denormals_as(uint32_t before) { denormals_as(before); }
