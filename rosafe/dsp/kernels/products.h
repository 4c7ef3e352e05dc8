/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags. */
#ifndef ROSAFE_PRODUCTS_H
#define ROSAFE_PRODUCTS_H

#include "vector.h"

enum {
    SPAN = 1024,      /* samples at a time: all that belongs to these stays in the second-level cache */
    MOST_LAGS = 1024, /* FFT is faster beyond */
    LONGEST = (SPAN + MOST_LAGS) / 2,
};

/* The even samples of a sequence, and the odd ones. */
typedef vec halves[2][LONGEST];

INLINE vec *at(halves of, int64_t t) { return of[t & 1] + (t >> 1); }

INLINE void put_zeros(halves to, int64_t t, int64_t until) {
    for (; t < until; t++) *at(to, t) = (vec){};
}

/* For n samples r and `lags` lags, at most SPAN and MOST_LAGS. Behind the n + lags - 1 samples l and behind r, zeros are put
 * where either is not even. */
INTERNAL void product(halves l, halves r, int64_t n, int64_t lags, halves c);

#endif
