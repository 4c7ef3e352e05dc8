/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags.
 *
 * With samples and lags split into even and odd ones, the sum is a product of a matrix of Toeplitz blocks and a vector,
 *
 *     c even = A r0 + B r1 = B (r0 + r1) + (A - B) r0      A: even samples of l, B: odd ones,
 *     c odd  = B r0 + C r1 = B (r0 + r1) + (C - B) r1      C: even samples from the next one on,
 *
 * three products of a quarter of the size instead of four (Karatsuba's way, as in fast FIR filters: Z.-J. Mou and
 * P. Duhamel (1991), IEEE Trans. Signal Processing 39). These are done directly, as many lags at a time as there are registers
 * for their sums. */
#include "products.h"

enum { LAGS_AT_ONCE = 13 /* of 16 registers */ };

INLINE void some_lags(const int lags, const vec *l, const vec *r, int64_t n, vec *c) {
    vec sum[LAGS_AT_ONCE];
    UNROLL for (int m = 0; m < lags; m++) sum[m] = c[m];
    for (int64_t t = 0; t < n; t++) {
        vec x = r[t];
        UNROLL for (int m = 0; m < lags; m++) sum[m] = fused(l[t + m], x, sum[m]);
        if (LANES < 8) __asm__ volatile(""); /* keeps GCC from moving sums to memory; AVX-512 has registers enough */
    }
    UNROLL for (int m = 0; m < lags; m++) c[m] = sum[m];
}

/* c[m] += sum_t l[t+m] r[t], n samples and `lags` lags. */
static void add_products(const vec *l, const vec *r, int64_t n, int64_t lags, vec *c) {
    for (int64_t m = 0, size; m < lags; m += size) {
        const int64_t times = (lags - m + LAGS_AT_ONCE - 1) / LAGS_AT_ONCE;
        size = (lags - m) / times;
        switch (size) {
#define CASE(size) case size: some_lags(size, l + m, r, n, c + m); break;
            CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8) CASE(9) CASE(10) CASE(11) CASE(12) CASE(13)
#undef CASE
        }
    }
}

void product(halves l, halves r, int64_t n, int64_t lags, halves c) {
    const int64_t half = (n + 1) / 2, half_lags = (lags + 1) / 2, length = half + half_lags;
    vec sum[SPAN / 2], difference[LONGEST];
    if (length < 2) return;
    put_zeros(l, n + lags - 1, 2 * length);
    put_zeros(r, n, 2 * half);
    for (int64_t t = 0; t < half; t++) sum[t] = r[0][t] + r[1][t];
    for (int64_t m = 0; m < half_lags; m++) c[0][m] = (vec){};
    add_products(l[1], sum, half, half_lags, c[0]);
    for (int64_t m = 0; m < half_lags; m++) c[1][m] = c[0][m];
    for (int64_t t = 0; t < length - 1; t++) difference[t] = l[0][t] - l[1][t];
    add_products(difference, r[0], half, half_lags, c[0]);
    for (int64_t t = 0; t < length - 1; t++) difference[t] = l[0][t + 1] - l[1][t];
    add_products(difference, r[1], half, half_lags, c[1]);
}
