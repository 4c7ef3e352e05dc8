/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags.
 *
 * With samples and lags split into even and odd ones, the sum is a product of a matrix of Toeplitz blocks and a vector,
 *
 *     c even = A r0 + B r1 = B (r0 + r1) + (A - B) r0      A: even samples of l, B: odd ones,
 *     c odd  = B r0 + C r1 = B (r0 + r1) + (C - B) r1      C: even samples from the next one on,
 *
 * three products of a quarter of the size instead of four (Karatsuba's way, as in fast FIR filters: Z.-J. Mou and
 * P. Duhamel (1991), IEEE Trans. Signal Processing 39), and each of these is split in the same way: nine instead of
 * sixteen. What they take is made of four samples at a time, in one go. They are done directly, as many lags at a time as
 * there are registers for their sums. */
#include "products.h"

enum {
    LAGS_AT_ONCE = 13, /* of 16 registers */
    PHASES = 4,
    PRODUCTS = 9,
    APART = 4, /* so that samples of the nine at the same time do not want the same place in the cache */
};

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

void product(long_sequence l, short_sequence r, int64_t n, int64_t lags, sums c) {
    const int64_t quarter = (n + PHASES - 1) / PHASES, quarter_lags = (lags + PHASES - 1) / PHASES;
    vec l_parts[PRODUCTS][(SPAN + MOST_LAGS) / PHASES + APART], r_parts[PRODUCTS][SPAN / PHASES + APART];
    vec part[PRODUCTS][MOST_LAGS / PHASES + APART];
    put_zeros(l, n + lags - 1, PHASES * (quarter + quarter_lags) + 3);
    put_zeros(r, n, PHASES * quarter);
    for (int64_t t = 0; t < quarter + quarter_lags; t++) {
        const vec *x = l + PHASES * t;
        const vec even = x[2] - x[3], odd = x[4] - x[3];
        const vec to[PRODUCTS] = {x[3], x[1] - x[3], x[5] - x[3],
                                  even, (x[0] - x[1]) - even, (x[4] - x[5]) - even,
                                  odd,  (x[2] - x[1]) - odd,  (x[6] - x[5]) - odd};
        UNROLL for (int k = 0; k < PRODUCTS; k++) l_parts[k][t] = to[k];
    }
    for (int64_t t = 0; t < quarter; t++) {
        const vec *x = r + PHASES * t;
        const vec first = x[0] + x[1], second = x[2] + x[3];
        const vec to[PRODUCTS] = {first + second, first, second, x[0] + x[2], x[0], x[2], x[1] + x[3], x[1], x[3]};
        UNROLL for (int k = 0; k < PRODUCTS; k++) r_parts[k][t] = to[k];
    }
    for (int k = 0; k < PRODUCTS; k++) {
        put_zeros(part[k], 0, quarter_lags);
        add_products(l_parts[k], r_parts[k], quarter, quarter_lags, part[k]);
    }
    for (int64_t m = 0; m < quarter_lags; m++) {
        const vec early = part[0][m] + part[1][m], late = part[0][m] + part[2][m];
        vec *to = c + PHASES * m;
        to[0] = early + (part[3][m] + part[4][m]);
        to[1] = early + (part[6][m] + part[7][m]);
        to[2] = late + (part[3][m] + part[5][m]);
        to[3] = late + (part[6][m] + part[8][m]);
    }
}
