/* Which of the libraries the processor can run. This one function is compiled for any x86-64, so that it can be asked of
 * the library for the lesser processors anywhere. */

/* 4 or 3 for x86-64-v4 (AVX-512) or x86-64-v3 (AVX2, FMA), 0 for less. */
__attribute__((target("arch=x86-64"))) int rosafe_processor_level(void) {
    __builtin_cpu_init();
    if (__builtin_cpu_supports("x86-64-v4")) return 4;
    return __builtin_cpu_supports("x86-64-v3") ? 3 : 0;
}
