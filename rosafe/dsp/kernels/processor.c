/* Which of the libraries the processor can run, and how a thread of it takes denormal numbers. The first function is compiled
 * for any x86-64, so that it can be asked of the library for the lesser processors anywhere. */
#include "vector.h"

/* 4 or 3 for x86-64-v4 (AVX-512) or x86-64-v3 (AVX2, FMA), 0 for less. */
__attribute__((target("arch=x86-64"))) int rosafe_processor_level(void) {
    __builtin_cpu_init();
    if (__builtin_cpu_supports("x86-64-v4")) return 4;
    return __builtin_cpu_supports("x86-64-v3") ? 3 : 0;
}

/* For what is not a kernel; returns what to give back to rosafe_denormals_as. */
uint32_t rosafe_denormals_off(void) { return denormals_off(); }
void rosafe_denormals_as(uint32_t before) { denormals_as(before); }
