/* Sums c[m] = sum_t l[t+m] r[t] of sequences in lanes, over few lags. */
#ifndef ROSAFE_PRODUCTS_H
#define ROSAFE_PRODUCTS_H

#include "vector.h"

enum {
    SPAN = 1024,      /* samples at a time: all that belongs to these stays in the second-level cache */
    MOST_LAGS = 1024, /* FFT is faster beyond */
    MOST_HALVINGS = 3,
    MOST_PHASES = 1 << MOST_HALVINGS,
    LONGEST = SPAN + MOST_LAGS + MOST_PHASES * (MOST_HALVINGS + 2),
};

/* How often to halve sequences r of `size` samples, at most SPAN, for so many lags. */
INTERNAL int best_halvings(int64_t size, int64_t lags);

/* Sums of sequences in 2^halvings phases: r and c with n and `lags` elements in each, l with n + lags - 1 + halvings. */
INTERNAL void product(int halvings, const vec *const *l, const vec *const *r, int64_t n, int64_t lags, vec *const *c,
                      vec *scratch);

/* Samples in 2^halvings phases, `length` in each. */
typedef struct {
    vec *samples;
    int64_t halvings, length;
} phases;

INLINE vec *at(phases to, int64_t t) {
    return to.samples + (t & ((1 << to.halvings) - 1)) * to.length + (t >> to.halvings);
}

INLINE void put_zeros(phases to, int64_t t, int64_t until) {
    for (; t < until; t++) *at(to, t) = (vec){};
}

#endif
