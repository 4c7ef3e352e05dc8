/* Four doubles in one register, in GCC's vector extensions: what all kernels are made of.
 *
 * The recursive kernels keep four rows (of ears times channels) in the four lanes: the samples of one row depend on one
 * another, those of four rows do not. Rows lie far apart in memory; they are read and written in tiles of four rows by
 * two samples, which are transposed in registers. Rounding is the same everywhere: a product and a sum are fused where
 * `fused` says so and nowhere else (-ffp-contract=off). */
#ifndef ROSAFE_VECTOR_H
#define ROSAFE_VECTOR_H

#include <stdint.h>

enum { LANES = 4 };

typedef double v4 __attribute__((vector_size(32)));
typedef double v2 __attribute__((vector_size(16)));
typedef double v4_anywhere __attribute__((vector_size(32), aligned(8), may_alias));
typedef double v2_anywhere __attribute__((vector_size(16), aligned(8), may_alias));

#define INLINE static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16") /* -O2 leaves even loops over four things rolled */

/* As in rosafe/dsp/guard.py: samples are bounded to LIMIT; states below TINY become 0 at the end of a block. */
#define LIMIT 1e70
#define TINY 1e-200

INLINE v2 load2(const double *from) { return *(const v2_anywhere *)from; }
INLINE void store2(double *to, v2 x) { *(v2_anywhere *)to = x; }
INLINE v4 load(const double *from) { return *(const v4_anywhere *)from; }
INLINE void store(double *to, v4 x) { *(v4_anywhere *)to = x; }
INLINE v4 all(double x) { return (v4){x, x, x, x}; }
INLINE double flushed(double state) { return state < TINY && state > -TINY ? 0.0 : state; }
INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }
INLINE int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }

#ifdef __x86_64__
INLINE v4 fused(v4 a, v4 b, v4 c) { return __builtin_ia32_vfmaddpd256(a, b, c); } /* a b + c */
INLINE v4 smaller(v4 a, v4 b) { return __builtin_ia32_minpd256(a, b); }
INLINE v4 larger(v4 a, v4 b) { return __builtin_ia32_maxpd256(a, b); }
INLINE v4 root(v4 a) { return __builtin_ia32_sqrtpd256(a); }

/* Denormal numbers are 0 inside the kernels: they are below anything that is heard, and make arithmetic many times
 * slower. The bits are those of the control register for "flush to zero" and "denormals are zero". */
INLINE uint32_t denormals_off(void) {
    uint32_t before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | 0x8040);
    return before;
}
INLINE void denormals_as(uint32_t before) { __builtin_ia32_ldmxcsr(before); }
#else
#error "these kernels are for x86-64; numpy and scipy serve elsewhere"
#endif

INLINE v4 bounded(v4 x, double low, double high) { return larger(smaller(x, all(high)), all(low)); }

INLINE v4 gathered(const double *const rows[LANES], int64_t t) {
    return (v4){rows[0][t], rows[1][t], rows[2][t], rows[3][t]};
}

/* Two samples of four rows, from memory to lanes and back. By halves of registers: a whole tile of four by four would take
 * twice the shuffles. */
INLINE void read_pair(const double *const rows[LANES], int64_t t, v4 pair[2]) {
    v4 even = __builtin_shufflevector(load2(rows[0] + t), load2(rows[2] + t), 0, 1, 2, 3);
    v4 odd = __builtin_shufflevector(load2(rows[1] + t), load2(rows[3] + t), 0, 1, 2, 3);
    pair[0] = __builtin_shufflevector(even, odd, 0, 4, 2, 6);
    pair[1] = __builtin_shufflevector(even, odd, 1, 5, 3, 7);
}

INLINE void write_pair(v4 first, v4 second, double *const rows[LANES], int64_t t) {
    v4 even = __builtin_shufflevector(first, second, 0, 4, 2, 6), odd = __builtin_shufflevector(first, second, 1, 5, 3, 7);
    store2(rows[0] + t, __builtin_shufflevector(even, even, 0, 1));
    store2(rows[1] + t, __builtin_shufflevector(odd, odd, 0, 1));
    store2(rows[2] + t, __builtin_shufflevector(even, even, 2, 3));
    store2(rows[3] + t, __builtin_shufflevector(odd, odd, 2, 3));
}

/* n samples of four rows, bounded to low..high, to samples[0], samples[step]...; and back. */
INLINE void read_rows(const double *const rows[LANES], int64_t n, double low, double high, v4 *samples, const int64_t step) {
    int64_t t = 0;
    for (; t + 2 <= n; t += 2) {
        v4 pair[2];
        read_pair(rows, t, pair);
        samples[t * step] = bounded(pair[0], low, high);
        samples[(t + 1) * step] = bounded(pair[1], low, high);
    }
    if (t < n) samples[t * step] = bounded(gathered(rows, t), low, high);
}

INLINE void write_rows(const v4 *samples, const int64_t step, int64_t n, double *const rows[LANES]) {
    int64_t t = 0;
    for (; t + 2 <= n; t += 2) write_pair(samples[t * step], samples[(t + 1) * step], rows, t);
    if (t < n)
        UNROLL for (int k = 0; k < LANES; k++) rows[k][t] = samples[t * step][k];
}

#endif
