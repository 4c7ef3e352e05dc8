/* One register of doubles, in GCC's vector extensions: what all kernels are made of.
 *
 * Four doubles, or eight where the compiler is told of AVX-512; the kernels are written for any number of lanes. The
 * recursive ones keep a row (an ear's channel) in each lane: the samples of one row depend on one another, those of several
 * rows do not. Rows lie far apart in memory; they are read and written two samples of all lanes at a time. Rounding is the
 * same everywhere: a product and a sum are fused where `fused` says so and nowhere else (-ffp-contract=off). */
#ifndef ROSAFE_VECTOR_H
#define ROSAFE_VECTOR_H

#include <stdint.h>

#define INLINE static inline __attribute__((always_inline))
#define INTERNAL __attribute__((visibility("hidden"))) /* between the sources; not for Python */
#define UNROLL _Pragma("GCC unroll 32") /* -O2 leaves even loops over four things rolled */

/* As in rosafe/dsp/guard.py: samples are bounded to LIMIT; states below TINY become 0 at the end of a block. */
#define LIMIT 1e70
#define TINY 1e-200

#ifdef __AVX512F__
enum { LANES = 8, STEPS = 3 /* of doubling, from 1 to LANES */ };
#else
enum { LANES = 4, STEPS = 2 };
#endif

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef double vec_anywhere __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
typedef int64_t lanes __attribute__((vector_size(8 * LANES)));
typedef double duo __attribute__((vector_size(16), aligned(8), may_alias)); /* neighbours in memory */
typedef double quartet __attribute__((vector_size(32)));

INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }
INLINE int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }
INLINE vec load(const double *from) { return *(const vec_anywhere *)from; }
INLINE double flushed(double state) { return state < TINY && state > -TINY ? 0.0 : state; }

/* --- what takes the processor's own instructions --- */

INLINE quartet together(duo a, duo b) { return __builtin_shufflevector(a, b, 0, 1, 2, 3); }

#ifdef __AVX512F__
enum { EVERY_LANE = 255, AS_USUAL = 4 /* rounding */ };
INLINE vec all(double x) { return (vec){x, x, x, x, x, x, x, x}; }
INLINE vec fused(vec a, vec b, vec c) { return __builtin_ia32_vfmaddpd512_mask(a, b, c, EVERY_LANE, AS_USUAL); }
INLINE vec smaller(vec a, vec b) { return __builtin_ia32_minpd512_mask(a, b, b, EVERY_LANE, AS_USUAL); }
INLINE vec larger(vec a, vec b) { return __builtin_ia32_maxpd512_mask(a, b, b, EVERY_LANE, AS_USUAL); }
INLINE vec root(vec a) { return __builtin_ia32_sqrtpd512_mask(a, a, EVERY_LANE, AS_USUAL); }
INLINE vec evens(vec a, vec b) { return __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14); }
INLINE vec odds(vec a, vec b) { return __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15); }
INLINE vec every_second(const duo row[LANES]) {
    return __builtin_shufflevector(together(row[0], row[2]), together(row[4], row[6]), 0, 1, 2, 3, 4, 5, 6, 7);
}
INLINE vec last(vec a) { return __builtin_shufflevector(a, a, 7, 7, 7, 7, 7, 7, 7, 7); }
/* Lane k + 2^step has what lane k had; 0 in the first ones. */
INLINE vec delayed(vec a, const int step) {
    return step == 0   ? __builtin_shufflevector(a, (vec){}, 8, 0, 1, 2, 3, 4, 5, 6)
           : step == 1 ? __builtin_shufflevector(a, (vec){}, 8, 9, 0, 1, 2, 3, 4, 5)
                       : __builtin_shufflevector(a, (vec){}, 8, 9, 10, 11, 0, 1, 2, 3);
}
/* At most LANES doubles, 0 in the lanes behind them; what lies there is not touched. */
INLINE vec load_first(const double *from, int64_t n) {
    return __builtin_ia32_loadupd512_mask(from, (vec){}, n < LANES ? (1 << n) - 1 : EVERY_LANE);
}
#else
INLINE vec all(double x) { return (vec){x, x, x, x}; }
INLINE vec fused(vec a, vec b, vec c) { return __builtin_ia32_vfmaddpd256(a, b, c); } /* a b + c */
INLINE vec smaller(vec a, vec b) { return __builtin_ia32_minpd256(a, b); }
INLINE vec larger(vec a, vec b) { return __builtin_ia32_maxpd256(a, b); }
INLINE vec root(vec a) { return __builtin_ia32_sqrtpd256(a); }
INLINE vec evens(vec a, vec b) { return __builtin_shufflevector(a, b, 0, 4, 2, 6); }
INLINE vec odds(vec a, vec b) { return __builtin_shufflevector(a, b, 1, 5, 3, 7); }
INLINE vec every_second(const duo row[LANES]) { return together(row[0], row[2]); }
INLINE vec last(vec a) { return __builtin_shufflevector(a, a, 3, 3, 3, 3); }
INLINE vec delayed(vec a, const int step) {
    return step == 0 ? __builtin_shufflevector(a, (vec){}, 4, 0, 1, 2) : __builtin_shufflevector(a, (vec){}, 4, 5, 0, 1);
}
INLINE vec load_first(const double *from, int64_t n) {
    return __builtin_ia32_maskloadpd256((const vec *)from, (lanes){0, 1, 2, 3} < n);
}
#endif

INLINE double total(vec x) {
    double sum = 0.0;
    UNROLL for (int k = 0; k < LANES; k++) sum += x[k];
    return sum;
}

INLINE vec bounded(vec x, double low, double high) { return larger(smaller(x, all(high)), all(low)); }

/* Denormal numbers are 0 inside the kernels: they are below anything that is heard, and make arithmetic many times
 * slower. The bits are those of the control register for "flush to zero" and "denormals are zero". */
INLINE uint32_t denormals_off(void) {
    uint32_t before = __builtin_ia32_stmxcsr();
    __builtin_ia32_ldmxcsr(before | 0x8040);
    return before;
}
INLINE void denormals_as(uint32_t before) { __builtin_ia32_ldmxcsr(before); }

/* --- rows in memory, samples of all rows in a register --- */

INLINE vec gathered(const double *const rows[LANES], int64_t t) {
    vec x;
    UNROLL for (int k = 0; k < LANES; k++) x[k] = rows[k][t];
    return x;
}

/* Samples t and t + 1. By pairs: transposing whole tiles takes twice the shuffles. */
INLINE void read_pair(const double *const rows[LANES], int64_t t, vec pair[2]) {
    duo row[LANES + 1];
    UNROLL for (int k = 0; k < LANES; k++) row[k] = *(const duo *)(rows[k] + t);
    row[LANES] = row[0];
    vec even = every_second(row), odd = every_second(row + 1);
    pair[0] = evens(even, odd);
    pair[1] = odds(even, odd);
}

INLINE void write_pair(vec first, vec second, double *const rows[LANES], int64_t t) {
    vec even = evens(first, second), odd = odds(first, second);
    UNROLL for (int k = 0; k < LANES; k += 2) {
        *(duo *)(rows[k] + t) = (duo){even[k], even[k + 1]};
        *(duo *)(rows[k + 1] + t) = (duo){odd[k], odd[k + 1]};
    }
}

/* n samples, bounded to low..high, to samples[0], samples[step]...; and back. */
INLINE void read_rows(const double *const rows[LANES], int64_t n, double low, double high, vec *samples,
                      const int64_t step) {
    int64_t t = 0;
    for (; t + 2 <= n; t += 2) {
        vec pair[2];
        read_pair(rows, t, pair);
        samples[t * step] = bounded(pair[0], low, high);
        samples[(t + 1) * step] = bounded(pair[1], low, high);
    }
    if (t < n) samples[t * step] = bounded(gathered(rows, t), low, high);
}

INLINE void write_rows(const vec *samples, const int64_t step, int64_t n, double *const rows[LANES]) {
    int64_t t = 0;
    for (; t + 2 <= n; t += 2) write_pair(samples[t * step], samples[(t + 1) * step], rows, t);
    if (t < n)
        UNROLL for (int k = 0; k < LANES; k++) rows[k][t] = samples[t * step][k];
}

#endif
