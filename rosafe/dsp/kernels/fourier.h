/* Fourier transforms of rows, one per lane.
 *
 * A row of N real numbers is treated as N / 2 complex ones: J. W. Cooley, P. A. W. Lewis and P. D. Welch (1970), J. Sound Vib.
 * 12, 315-337. The output is in digit-reversed order. Radix-4 butterflies; each transform is computed quarter by quarter, so that all
 * passes except the first stay in the cache (R. C. Singleton (1967), Comm. ACM 10). */
#ifndef ROSAFE_FOURIER_H
#define ROSAFE_FOURIER_H

#include "vector.h"

enum { MAX_POINTS = 4096 /* complex */ };

typedef struct {
    vec re, im;
} complexes;

typedef struct {
    double re, im;
} number;

INLINE complexes sum(complexes a, complexes b) { return (complexes){a.re + b.re, a.im + b.im}; }
INLINE complexes difference(complexes a, complexes b) { return (complexes){a.re - b.re, a.im - b.im}; }
INLINE complexes times_i(complexes a) { return (complexes){-a.im, a.re}; }
INLINE complexes times(complexes a, number w) {
    return (complexes){fused(a.re, all(w.re), -(a.im * all(w.im))), fused(a.re, all(w.im), a.im * all(w.re))};
}
INLINE complexes times_conjugate(complexes a, number w) { return times(a, (number){w.re, -w.im}); }

/* Twiddles: for n points exp(-2 pi i j k / n), j = 1, 2, 3 for each k < n / 4, followed by those for n / 4 points.
 * `half`: the upper half is 0 and is not read. */
INLINE void butterflies_there(complexes *x, int64_t n, const number *w, const int half) {
    const int64_t q = n / 4;
    for (int64_t k = 0; k < q; k++, w += 3) {
        const complexes a = x[k], b = x[k + q], none = {}, c = half ? none : x[k + 2 * q], d = half ? none : x[k + 3 * q];
        complexes even = half ? a : sum(a, c), odd = half ? a : difference(a, c);
        complexes even2 = half ? b : sum(b, d), odd2 = times_i(half ? b : difference(b, d));
        x[k] = sum(even, even2);
        x[k + q] = times(difference(odd, odd2), w[0]);
        x[k + 2 * q] = times(difference(even, even2), w[1]);
        x[k + 3 * q] = times(sum(odd, odd2), w[2]);
    }
}

INLINE void pair(complexes *x) {
    complexes a = x[0], b = x[1];
    x[0] = sum(a, b);
    x[1] = difference(a, b);
}

static void there(complexes *x, int64_t n, const number *w) {
    if (n == 2) pair(x);
    if (n < 4) return;
    butterflies_there(x, n, w, 0);
    for (int64_t i = 0; i < 4; i++) there(x + i * (n / 4), n / 4, w + 3 * (n / 4));
}

/* The same if the upper half of x is 0; it need not be set if n is at least 4. */
static void there_from_half(complexes *x, int64_t n, const number *w) {
    if (n < 4) {
        there(x, n, w);
        return;
    }
    butterflies_there(x, n, w, 1);
    for (int64_t i = 0; i < 4; i++) there(x + i * (n / 4), n / 4, w + 3 * (n / 4));
}

/* Four times the powers of the real numbers at frequencies k and N / 2 - k, given the complex values there and
 * turn = exp(2 pi i k / N). */
INLINE void powers(complexes a, complexes b, number turn, vec both[2]) {
    vec cosine = all(turn.re), sine = all(turn.im);
    complexes even = {a.re + b.re, a.im - b.im}, odd = {a.im + b.im, b.re - a.re};
    odd = (complexes){fused(odd.re, cosine, odd.im * sine), fused(odd.im, cosine, -(odd.re * sine))};
    complexes low = sum(even, odd), high = difference(even, odd);
    both[0] = fused(low.re, low.re, low.im * low.im);
    both[1] = fused(high.re, high.re, high.im * high.im);
}

#endif
