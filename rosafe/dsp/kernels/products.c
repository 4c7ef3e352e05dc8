/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags.
 *
 * With samples and lags split into even and odd ones, the sum is a product of a matrix of Toeplitz blocks and a vector,
 *
 *     c even = A r0 + B r1 = B (r0 + r1) + (A - B) r0      A: even samples of l, B: odd ones,
 *     c odd  = B r0 + C r1 = B (r0 + r1) + (C - B) r1      C: even samples from the next one on,
 *
 * three products of a quarter of the size instead of four (Karatsuba's way, as in fast FIR filters: Z.-J. Mou and
 * P. Duhamel (1991), IEEE Trans. Signal Processing 39). Applied up to three times; the phases of l, r and c that this
 * takes apart lie apart from the start, so that only sums and differences are computed. What remains is done directly, as many
 * lags at a time as there are registers for their sums. */
#include "products.h"

enum { LAGS_AT_ONCE = LANES == 8 ? 25 : 13 /* of 32 or 16 registers */ };

INLINE void some_lags(const int lags, const vec *l, const vec *r, int64_t n, vec *c) {
    vec sum[LAGS_AT_ONCE];
    UNROLL for (int m = 0; m < lags; m++) sum[m] = (vec){};
    for (int64_t t = 0; t < n; t++) {
        vec x = r[t];
        UNROLL for (int m = 0; m < lags; m++) sum[m] = fused(l[t + m], x, sum[m]);
        __asm__ volatile(""); /* keeps the compiler from moving sums to memory */
    }
    UNROLL for (int m = 0; m < lags; m++) c[m] = sum[m];
}

/* c[m] = sum_t l[t+m] r[t], n samples and `lags` lags. */
static void direct(const vec *l, const vec *r, int64_t n, int64_t lags, vec *c) {
    int64_t times = (lags + LAGS_AT_ONCE - 1) / LAGS_AT_ONCE, size = (lags + times - 1) / times;
    for (int64_t first = 0; first < lags; first += size) {
        int64_t m = least(first, lags - size); /* the last ones overlap those before */
        switch (size) {
#define CASE(size) case size: some_lags(size, l + m, r, n, c + m); break;
            CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8) CASE(9) CASE(10) CASE(11) CASE(12) CASE(13)
#ifdef __AVX512F__
            CASE(14) CASE(15) CASE(16) CASE(17) CASE(18) CASE(19) CASE(20) CASE(21) CASE(22) CASE(23) CASE(24) CASE(25)
#endif
#undef CASE
        }
    }
}

INLINE void add(const vec *a, const vec *b, int64_t n, vec *sum) {
    _Pragma("GCC unroll 4") for (int64_t t = 0; t < n; t++) sum[t] = a[t] + b[t];
}

INLINE void subtract(const vec *a, const vec *b, int64_t n, vec *difference) {
    _Pragma("GCC unroll 4") for (int64_t t = 0; t < n; t++) difference[t] = a[t] - b[t];
}

void product(int halvings, const vec *const *l, const vec *const *r, int64_t n, int64_t lags, vec *const *c, vec *scratch) {
    if (halvings == 0) {
        direct(l[0], r[0], n, lags, c[0]);
        return;
    }
    enum { MOST_HALF = MOST_PHASES / 2 };
    const int half = 1 << (halvings - 1);
    const int64_t length = n + lags - 1 + halvings - 1;
    const vec *odd[MOST_HALF], *sum[MOST_HALF], *difference[MOST_HALF] = {0}, *part[MOST_HALF] = {0};
    vec *common[MOST_HALF], *own[MOST_HALF];
    for (int i = 0; i < half; i++) {
        odd[i] = l[2 * i + 1];
        common[i] = scratch;
        own[i] = common[i] + lags;
        add(r[2 * i], r[2 * i + 1], n, own[i] + lags);
        sum[i] = own[i] + lags;
        scratch = own[i] + lags + n;
    }
    product(halvings - 1, odd, sum, n, lags, common, scratch);
    for (int parity = 0; parity < 2; parity++) {
        vec *free = scratch;
        for (int i = 0; i < half; i++, free += length) {
            int even = 2 * (i + parity); /* for odd lags, even samples from the next one on */
            subtract(even < 2 * half ? l[even] : l[0] + 1, odd[i], length, free);
            difference[i] = free;
            part[i] = r[2 * i + parity];
        }
        product(halvings - 1, difference, part, n, lags, own, free);
        for (int i = 0; i < half; i++) add(common[i], own[i], lags, c[2 * i + parity]);
    }
}

/* Where the work is least, counted in fused multiplications and additions that need no store. */
int best_halvings(int64_t size, int64_t lags) {
    const double sum_stored = LANES == 8 ? 3.0 : 1.5; /* as measured */
    int best = 0;
    double least_cost = 1e300;
    for (int halvings = 0; halvings <= MOST_HALVINGS; halvings++) {
        int64_t phases = 1 << halvings, n = (size + phases - 1) / phases, m = (lags + phases - 1) / phases;
        int64_t times = (m + LAGS_AT_ONCE - 1) / LAGS_AT_ONCE, computed = times * ((m + times - 1) / times);
        double products = 1, cost = 0;
        for (int64_t half = phases / 2; half > 0; half /= 2, products *= 3) cost += sum_stored * products * half * (3 * n + 2 * m);
        cost += products * n * (computed + 2);
        if (cost < least_cost) least_cost = cost, best = halvings;
    }
    return best;
}
