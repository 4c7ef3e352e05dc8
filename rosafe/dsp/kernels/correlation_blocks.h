/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags. */
#ifndef ROSAFE_PRODUCTS_H
#define ROSAFE_PRODUCTS_H

#include "vector.h"

enum {
    SPAN = 1024,      /* samples at a time: their data stay in the L2 cache */
    MAX_LAGS = 1024, /* FFT is faster for more */
    SPARE = 20,       /* elements after a sequence, for `product` */
};

typedef vec long_sequence[SPAN + MAX_LAGS + SPARE]; /* l */
typedef vec short_sequence[SPAN + SPARE];            /* r */
typedef vec sums[MAX_LAGS + SPARE];                 /* c */

INLINE void put_zeros(vec *to, int64_t t, int64_t until) {
    for (; t < until; t++) to[t] = (vec){};
}

/* For n samples r and `lags` lags, at most SPAN and MAX_LAGS. Up to SPARE elements are written after the n + lags - 1 samples
 * l, the n samples r and the sums. */
INTERNAL void product(long_sequence l, short_sequence r, int64_t n, int64_t lags, sums c);

#endif
