/* One register of doubles, by the vector extensions of GCC and clang: the basis of all kernels.
 *
 * Two doubles, four with AVX2, eight with AVX-512; the kernels are written for any number of lanes. Recursive kernels process
 * one row (a channel of an ear) per lane: the samples of one row depend on each other, those of several rows do not. Rounding
 * follows the source: a product and a sum are fused only by `fused`, if the processor supports it (-ffp-contract=off). */
#ifndef ROSAFE_VECTOR_H
#define ROSAFE_VECTOR_H

#include <stdint.h>

#define INLINE static inline __attribute__((always_inline))
#define INTERNAL __attribute__((visibility("hidden"))) /* shared by the sources; not for Python */
#ifdef __clang__
#define UNROLL _Pragma("clang loop unroll(full)")
#else
#define UNROLL _Pragma("GCC unroll 32") /* -O2 does not unroll even loops of four iterations */
#endif

/* As in rosafe/dsp/numeric_limits.py: samples are clamped to LIMIT, and become 0 below TINY. */
#define LIMIT 1e70
#define TINY 1e-200

#if defined __AVX512F__
enum { LANES = 8, TILE = 4 /* samples to and from memory at a time */ };
#elif defined __AVX2__
enum { LANES = 4, TILE = 4 };
#else
enum { LANES = 2, TILE = 2 };
#endif

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef double vec_anywhere __attribute__((vector_size(8 * LANES), aligned(8), may_alias));
typedef int64_t lanes __attribute__((vector_size(8 * LANES)));
typedef double quartet __attribute__((vector_size(32)));
typedef double quartet_anywhere __attribute__((vector_size(32), aligned(8), may_alias));

INLINE int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }
INLINE int64_t most(int64_t a, int64_t b) { return a > b ? a : b; }
INLINE vec load(const double *from) { return *(const vec_anywhere *)from; }

INLINE vec all(double x) { return x - (vec){}; }
INLINE vec root(vec a) {
    UNROLL for (int k = 0; k < LANES; k++) a[k] = __builtin_sqrt(a[k]);
    return a;
}

/* --- instructions of the processor --- */

/* a b + c. Unlike clang, GCC does not generate the vector instructions here and in `smaller`. */
INLINE vec fused(vec a, vec b, vec c) {
#if defined __clang__ && (defined __FMA__ || defined __aarch64__)
    UNROLL for (int k = 0; k < LANES; k++) c[k] = __builtin_fma(a[k], b[k], c[k]);
    return c;
#elif defined __AVX512F__
    return __builtin_ia32_vfmaddpd512_mask(a, b, c, -1, 4 /* current rounding mode */);
#elif defined __FMA__
    return __builtin_ia32_vfmaddpd256(a, b, c);
#elif defined __aarch64__
    return __builtin_aarch64_fmav2df(a, b, c);
#else
    return a * b + c;
#endif
}

INLINE vec smaller(vec a, vec b) {
#if defined __AVX512F__ && !defined __clang__
    return __builtin_ia32_minpd512_mask(a, b, b, -1, 4);
#elif defined __AVX2__ && !defined __clang__
    return __builtin_ia32_minpd256(a, b);
#elif defined __SSE2__ && !defined __clang__
    return __builtin_ia32_minpd(a, b);
#else
    return (vec)(((lanes)a & (a < b)) | ((lanes)b & ~(a < b)));
#endif
}

INLINE vec larger(vec a, vec b) {
#if defined __AVX512F__ && !defined __clang__
    return __builtin_ia32_maxpd512_mask(a, b, b, -1, 4);
#elif defined __AVX2__ && !defined __clang__
    return __builtin_ia32_maxpd256(a, b);
#elif defined __SSE2__ && !defined __clang__
    return __builtin_ia32_maxpd(a, b);
#else
    return (vec)(((lanes)a & (a > b)) | ((lanes)b & ~(a > b)));
#endif
}

/* At most LANES doubles, 0 in the remaining lanes; memory after the doubles is not accessed. */
INLINE vec load_first(const double *from, int64_t n) {
#if defined __AVX512F__
    return __builtin_ia32_loadupd512_mask((const void *)from, (vec){}, n < LANES ? (1 << n) - 1 : -1);
#elif defined __AVX2__
    return __builtin_ia32_maskloadpd256((const void *)from, (lanes){0, 1, 2, 3} < n);
#else
    return n < LANES ? (vec){from[0]} : load(from);
#endif
}

/* Denormal numbers are 0 inside the kernels: they are inaudible and make arithmetic many times slower.
 * The bits are those of the control register for "flush to zero", on x86 for "denormals are zero" too. */
#if defined __x86_64__
INLINE uint32_t control(void) { return __builtin_ia32_stmxcsr(); }
INLINE void denormals_as(uint32_t before) { __builtin_ia32_ldmxcsr(before); }
enum { DENORMALS_OFF = 0x8040 };
#elif defined __aarch64__
INLINE uint32_t control(void) {
    uint64_t bits;
    __asm__ volatile("mrs %0, fpcr" : "=r"(bits));
    return bits;
}
INLINE void denormals_as(uint32_t before) { __asm__ volatile("msr fpcr, %0" : : "r"((uint64_t)before) : "memory"); }
enum { DENORMALS_OFF = 1 << 24 };
#endif
INLINE uint32_t denormals_off(void) {
    uint32_t before = control();
    denormals_as(before | DENORMALS_OFF);
    return before;
}

/* --- entry to and exit from a kernel --- */

INTERNAL void gate_in(void);
INTERNAL void gate_out(void);
INLINE uint32_t enter(void) {
    gate_in();
    return denormals_off();
}
INLINE void leave(uint32_t before) {
    denormals_as(before);
    gate_out();
}

/* --- permutations of lanes ---
 *
 * The even and the odd lanes of two registers, interleaved; the first or the last two of four samples of every second row,
 * pair by pair; and from such registers the samples of one row. */

#if defined __AVX512F__
INLINE vec evens(vec a, vec b) { return __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14); }
INLINE vec odds(vec a, vec b) { return __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15); }
INLINE vec both(quartet a, quartet b) { return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7); }
INLINE vec pairs(const quartet *row, const int half) {
    vec low = both(row[0], row[2]), high = both(row[4], row[6]);
    return half ? __builtin_shufflevector(low, high, 2, 3, 6, 7, 10, 11, 14, 15)
                : __builtin_shufflevector(low, high, 0, 1, 4, 5, 8, 9, 12, 13);
}
INLINE quartet row_of(vec early, vec late, const int pair) {
    vec two = pair < 2 ? __builtin_shufflevector(early, late, 0, 1, 8, 9, 2, 3, 10, 11)
                       : __builtin_shufflevector(early, late, 4, 5, 12, 13, 6, 7, 14, 15);
    return pair & 1 ? __builtin_shufflevector(two, two, 4, 5, 6, 7) : __builtin_shufflevector(two, two, 0, 1, 2, 3);
}
#elif defined __AVX2__
INLINE vec evens(vec a, vec b) { return __builtin_shufflevector(a, b, 0, 4, 2, 6); }
INLINE vec odds(vec a, vec b) { return __builtin_shufflevector(a, b, 1, 5, 3, 7); }
INLINE vec pairs(const quartet *row, const int half) {
    return half ? __builtin_shufflevector(row[0], row[2], 2, 3, 6, 7) : __builtin_shufflevector(row[0], row[2], 0, 1, 4, 5);
}
INLINE quartet row_of(vec early, vec late, const int pair) {
    return pair ? __builtin_shufflevector(early, late, 2, 3, 6, 7) : __builtin_shufflevector(early, late, 0, 1, 4, 5);
}
#else
INLINE vec evens(vec a, vec b) { return __builtin_shufflevector(a, b, 0, 2); }
INLINE vec odds(vec a, vec b) { return __builtin_shufflevector(a, b, 1, 3); }
#endif

INLINE double total(vec x) {
    double sum = 0.0;
    UNROLL for (int k = 0; k < LANES; k++) sum += x[k];
    return sum;
}

INLINE vec bounded(vec x, double low, double high) { return larger(smaller(x, all(high)), all(low)); }

/* --- rows in memory, samples of all rows in a register --- */

INLINE vec gathered(const double *const rows[LANES], int64_t t) {
    vec x;
    UNROLL for (int k = 0; k < LANES; k++) x[k] = rows[k][t];
    return x;
}

/* Samples t, t + 1... t + TILE - 1; and back. */
INLINE void read_tile(const double *const rows[LANES], int64_t t, vec tile[TILE]) {
#if defined __AVX2__
    quartet row[LANES];
    UNROLL for (int k = 0; k < LANES; k++) row[k] = *(const quartet_anywhere *)(rows[k] + t);
    UNROLL for (int half = 0; half < 2; half++) { /* of the samples */
        vec even = pairs(row, half), odd = pairs(row + 1, half);
        tile[2 * half] = evens(even, odd);
        tile[2 * half + 1] = odds(even, odd);
    }
#else
    vec row[LANES];
    UNROLL for (int k = 0; k < LANES; k++) row[k] = load(rows[k] + t);
    tile[0] = evens(row[0], row[1]);
    tile[1] = odds(row[0], row[1]);
#endif
}

INLINE void write_tile(const vec tile[TILE], double *const rows[LANES], int64_t t) {
#if defined __AVX2__
    vec early[2] = {evens(tile[0], tile[1]), odds(tile[0], tile[1])};
    vec late[2] = {evens(tile[2], tile[3]), odds(tile[2], tile[3])};
    UNROLL for (int k = 0; k < LANES; k++) *(quartet_anywhere *)(rows[k] + t) = row_of(early[k & 1], late[k & 1], k / 2);
#else
    *(vec_anywhere *)(rows[0] + t) = evens(tile[0], tile[1]);
    *(vec_anywhere *)(rows[1] + t) = odds(tile[0], tile[1]);
#endif
}

/* n samples, bounded to low..high, to samples[0], samples[step]...; and back. */
INLINE void read_rows(const double *const rows[LANES], int64_t n, double low, double high, vec *samples,
                      const int64_t step) {
    int64_t t = 0;
    for (; t + TILE <= n; t += TILE) {
        vec tile[TILE];
        read_tile(rows, t, tile);
        UNROLL for (int i = 0; i < TILE; i++) samples[(t + i) * step] = bounded(tile[i], low, high);
    }
    for (; t < n; t++) samples[t * step] = bounded(gathered(rows, t), low, high);
}

INLINE void write_rows(const vec *samples, const int64_t step, int64_t n, double *const rows[LANES]) {
    int64_t t = 0;
    for (; t + TILE <= n; t += TILE) {
        vec tile[TILE];
        UNROLL for (int i = 0; i < TILE; i++) tile[i] = samples[(t + i) * step];
        write_tile(tile, rows, t);
    }
    for (; t < n; t++)
        UNROLL for (int k = 0; k < LANES; k++) rows[k][t] = samples[t * step][k];
}

#endif
