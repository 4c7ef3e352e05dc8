/* Whether this processor can run the other kernels, which take AVX2, FMA and what else makes up x86-64-v3. This file's one
 * function is compiled for any x86-64, so that it can be asked anywhere. */

__attribute__((target("arch=x86-64"))) int rosafe_runs_here(void) {
    __builtin_cpu_init();
    return __builtin_cpu_supports("x86-64-v3") != 0;
}
