/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags.
 *
 * With samples and lags split into three phases, the sum is a product of a matrix of Toeplitz blocks and a vector,
 *
 *     c0 = A r0 + B r1 + C r2      A, B, C, D, E: every third sample of l, from sample 0, 1, 2, 3, 4 on,
 *     c1 = B r0 + C r1 + D r2
 *     c2 = C r0 + D r1 + E r2,
 *
 * which takes five products of a ninth of the size instead of nine: a polynomial of degree 4 is determined by its values at
 * five points, here 0, 1, -1, 2 and infinity, and this is the transposed algorithm (A. L. Toom for products, S. Winograd for
 * FIR filters: Arithmetic Complexity of Computations, SIAM 1980). Each of the five is split in the same way: 25 products
 * instead of 81, with sums accurate to about 1e-15 of the largest. Their inputs are computed from nine samples at a time in
 * one pass. They are evaluated directly, as many lags at a time as there are registers for the sums. */
#include "correlation_blocks.h"

enum {
    LAGS_AT_ONCE = 13, /* of 16 registers */
    WAYS = 3,
    POINTS = 5,
    PHASES = WAYS * WAYS,
    PRODUCTS = POINTS * POINTS,
    APART = 4, /* padding: samples of all products at the same time must not map to the same cache set */
};

INLINE void some_lags(const int lags, const vec *l, const vec *r, int64_t n, vec *c) {
    vec sum[LAGS_AT_ONCE];
    UNROLL for (int m = 0; m < lags; m++) sum[m] = (vec){};
    for (int64_t t = 0; t < n; t++) {
        vec x = r[t];
        UNROLL for (int m = 0; m < lags; m++) sum[m] = fused(l[t + m], x, sum[m]);
        if (LANES < 8) __asm__ volatile(""); /* keeps GCC from spilling sums to memory; AVX-512 has enough registers */
    }
    UNROLL for (int m = 0; m < lags; m++) c[m] = sum[m];
}

/* c[m] = sum_t l[t+m] r[t], n samples and `lags` lags. */
static void direct(const vec *l, const vec *r, int64_t n, int64_t lags, vec *c) {
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

/* The inputs of the product for a point: a combination of A to E of l, and the polynomial of r at that point. */
INLINE vec of_l(const int point, vec a, vec b, vec c, vec d, vec e) {
    const vec apart = b - d;
    return point == 0   ? fused(all(-0.5), apart, a - c)
           : point == 1 ? apart + (b + c) /* twice the value; `combine` corrects it */
           : point == 2 ? fused(all(3.0), c - b, apart) /* six times */
           : point == 3 ? apart /* minus six times */
                        : fused(all(2.0), apart, e - c);
}

INLINE vec of_r(const int point, vec a, vec b, vec c) {
    return point == 0   ? a
           : point == 1 ? (a + c) + b
           : point == 2 ? (a + c) - b
           : point == 3 ? fused(all(4.0), c, a) + (b + b)
                        : c;
}

/* Compute c0, c1 and c2 from the five products. */
INLINE void combine(const vec *products, vec *c) {
    const vec plus = products[1] * 0.5, minus = products[2] * (1.0 / 6), two = products[3] * (-1.0 / 6);
    c[0] = products[0] + ((plus + minus) + two);
    c[1] = (plus - minus) + 2.0 * two;
    c[2] = ((plus + minus) + 4.0 * two) + products[4];
}

INLINE vec third_of_l(const int point, const vec *l) { return of_l(point, l[0], l[1], l[2], l[3], l[4]); }
INLINE vec third_of_r(const int point, const vec *r) { return of_r(point, r[0], r[1], r[2]); }

void product(long_sequence l, short_sequence r, int64_t n, int64_t lags, sums c) {
    const int64_t ninth = (n + PHASES - 1) / PHASES, ninth_lags = (lags + PHASES - 1) / PHASES;
    vec l_parts[PRODUCTS][(SPAN + MAX_LAGS) / PHASES + APART], r_parts[PRODUCTS][SPAN / PHASES + APART];
    vec products[PRODUCTS][MAX_LAGS / PHASES + APART], thirds[POINTS][2];
    put_zeros(l, n + lags - 1, PHASES * (ninth + ninth_lags) - 1);
    put_zeros(r, n, PHASES * ninth);
    UNROLL for (int j = 0; j < POINTS; j++) thirds[j][0] = third_of_l(j, l), thirds[j][1] = third_of_l(j, l + WAYS);
    for (int64_t t = 0; t < ninth + ninth_lags - 1; t++) {
        const vec *x = l + PHASES * t + 2 * WAYS;
        UNROLL for (int j = 0; j < POINTS; j++) {
            const vec a = thirds[j][0], b = thirds[j][1], c = third_of_l(j, x);
            const vec d = third_of_l(j, x + WAYS), e = third_of_l(j, x + 2 * WAYS);
            thirds[j][0] = d, thirds[j][1] = e;
            UNROLL for (int k = 0; k < POINTS; k++) l_parts[POINTS * j + k][t] = of_l(k, a, b, c, d, e);
        }
    }
    for (int64_t t = 0; t < ninth; t++) {
        const vec *x = r + PHASES * t;
        UNROLL for (int j = 0; j < POINTS; j++) {
            const vec a = third_of_r(j, x), b = third_of_r(j, x + WAYS), c = third_of_r(j, x + 2 * WAYS);
            UNROLL for (int k = 0; k < POINTS; k++) r_parts[POINTS * j + k][t] = of_r(k, a, b, c);
        }
    }
    for (int k = 0; k < PRODUCTS; k++) direct(l_parts[k], r_parts[k], ninth, ninth_lags, products[k]);
    for (int64_t m = 0; m < ninth_lags; m++) {
        vec values[WAYS][POINTS];
        UNROLL for (int j = 0; j < POINTS; j++) {
            vec five[POINTS], third[WAYS];
            UNROLL for (int k = 0; k < POINTS; k++) five[k] = products[POINTS * j + k][m];
            combine(five, third);
            UNROLL for (int q = 0; q < WAYS; q++) values[q][j] = third[q];
        }
        UNROLL for (int q = 0; q < WAYS; q++) combine(values[q], c + PHASES * m + WAYS * q);
    }
}
