/* Adaptation loops: for each row a cascade of divisions by the low-pass filtered quotients
 * (rosafe/representations/adaptation.py).
 *
 * v = x; then for each loop v = limited(v / s), s = a s + b v, where limited(v) = 1 + m tanh((v - 1) / m) for v > 1.
 *
 * One row per lane. In tanh(u) = (1 - e) / (1 + e), e = exp(-2 u) = 2^k exp(r) with |r| at most ln(2) / 2; exp(r) is
 * Padé's quotient (E + O) / (E - O) of polynomials of degree 5, accurate to 1e-15. The output of a loop is then a quotient
 * N / D, and the next loop computes N / (D s): one division per loop instead of three. */
#include "vector.h"

enum { SPAN = 32, ROWS = 16, GROUPS = ROWS / LANES, MAX_LOOPS = 32 };

/* Quotients are limited so that no state becomes 0 or infinite; those of sound are far within the limits. */
#define MIN_QUOTIENT 1e-100
#define MAX_QUOTIENT 1e100

typedef struct {
    double a, b, m;
} loop;

typedef struct {
    vec threshold, offset, gain;
} row_constants;

/* 1 + m tanh((v - 1) / m) for v > 1, otherwise v, as n / d; rate is -2 / (m ln 2). */
INLINE void limit(vec v, vec m, vec rate, vec *n, vec *d) {
    const double L = 0.69314718055994530942, to_integer = 0x1.8p52; /* adding it puts the nearest integer into the lowest bits */
    vec exponent = larger(fused(larger(v, all(1.0)), rate, -rate), all(-60.0)); /* of e, to base 2; below the limit, tanh is 1 */
    vec shifted = exponent + to_integer, f = exponent - (shifted - to_integer), f2 = f * f;
    vec power = (vec)(((lanes)shifted << 52) + 0x3FF0000000000000L);
    vec even = fused(fused(all(L * L * L * L / 1008), f2, all(L * L / 9)), f2, all(1.0));
    vec odd = f * fused(fused(all(L * L * L * L * L / 30240), f2, all(L * L * L / 72)), f2, all(L / 2));
    vec less = all(1.0) - power, more = all(1.0) + power;
    *d = fused(even, more, -(odd * less));
    *n = fused(*d, smaller(v, all(1.0)), m * fused(even, less, -(odd * more)));
}

/* Apply all loops to one sample of GROUPS groups of rows. */
INLINE void step(const int limited, const int64_t count, const loop *loops, const double *rates, vec x[GROUPS],
                 vec states[MAX_LOOPS][GROUPS], const row_constants rows[GROUPS]) {
    if (limited) {
        vec n[GROUPS], d[GROUPS];
        UNROLL for (int g = 0; g < GROUPS; g++) n[g] = x[g], d[g] = all(1.0);
        for (int64_t j = 0; j < count; j++)
            UNROLL for (int g = 0; g < GROUPS; g++) {
                vec s = states[j][g], v = larger(n[g] / (d[g] * s), all(MIN_QUOTIENT));
                if (j > 0) states[j - 1][g] = fused(all(loops[j - 1].a), states[j - 1][g], all(loops[j - 1].b) * (v * s));
                limit(v, all(loops[j].m), all(rates[j]), n + g, d + g);
            }
        UNROLL for (int g = 0; g < GROUPS; g++) {
            x[g] = n[g] / d[g];
            states[count - 1][g] = fused(all(loops[count - 1].a), states[count - 1][g], all(loops[count - 1].b) * x[g]);
        }
    } else {
        for (int64_t j = 0; j < count; j++)
            UNROLL for (int g = 0; g < GROUPS; g++) {
                x[g] = bounded(x[g] / states[j][g], MIN_QUOTIENT, MAX_QUOTIENT);
                states[j][g] = fused(all(loops[j].a), states[j][g], all(loops[j].b) * x[g]);
            }
    }
    UNROLL for (int g = 0; g < GROUPS; g++) x[g] = (x[g] - rows[g].offset) * rows[g].gain;
}

INLINE void run(const int limited, const int64_t count, const loop *loops, const double *rates, vec *samples, int64_t n,
                vec states[MAX_LOOPS][GROUPS], const row_constants rows[GROUPS]) {
    for (int64_t t = 0; t < n; t++) step(limited, count, loops, rates, samples + t * GROUPS, states, rows);
}

/* block and output (rows, n); if `factor` is not 0, samples are first squared and multiplied by it. constants
 * (channels, 3): threshold, offset and gain of the output; row i belongs to channel i % channels.
 * loops (count, 3): a, b and m, without limits if `clamp` is 0; state (count, rows). */
void rosafe_adaptation(const double *block, int64_t rows, int64_t n, double factor, const double *constants, int64_t channels,
                       const double *of_loops, int64_t count, int64_t limited, double *state, double *output) {
    uint32_t mode = enter();
    const loop *loops = (const loop *)of_loops;
    double rates[MAX_LOOPS];
    for (int64_t j = 0; j < count; j++) rates[j] = -2 / (loops[j].m * 0.69314718055994530942);
    for (int64_t first = 0; first < rows; first += ROWS) {
        const double *from[ROWS]; /* lanes without a row repeat the last one */
        double *to[ROWS];
        int64_t row[ROWS];
        vec states[MAX_LOOPS][GROUPS], samples[SPAN * GROUPS];
        row_constants own[GROUPS];
        for (int k = 0; k < ROWS; k++) {
            row[k] = least(first + k, rows - 1);
            from[k] = block + row[k] * n;
            to[k] = output + row[k] * n;
            const double *mine = constants + 3 * (row[k] % channels);
            own[k / LANES].threshold[k % LANES] = mine[0];
            own[k / LANES].offset[k % LANES] = mine[1];
            own[k / LANES].gain[k % LANES] = mine[2];
            for (int64_t j = 0; j < count; j++) states[j][k / LANES][k % LANES] = state[j * rows + row[k]];
        }
        for (int64_t at = 0; at < n; at += SPAN) {
            int64_t span = least(SPAN, n - at);
            for (int g = 0; g < GROUPS; g++) {
                const double *mine[LANES];
                for (int k = 0; k < LANES; k++) mine[k] = from[g * LANES + k] + at;
                read_rows(mine, span, -LIMIT, LIMIT, samples + g, GROUPS);
                for (int64_t t = 0; t < span; t++) {
                    vec x = samples[t * GROUPS + g];
                    if (factor != 0) x = x * x * factor;
                    samples[t * GROUPS + g] = larger(x, own[g].threshold);
                }
            }
            if (limited)
                run(1, count, loops, rates, samples, span, states, own);
            else
                run(0, count, loops, rates, samples, span, states, own);
            for (int g = 0; g < GROUPS; g++) {
                double *mine[LANES];
                for (int k = 0; k < LANES; k++) mine[k] = to[g * LANES + k] + at;
                write_rows(samples + g, GROUPS, span, mine);
            }
        }
        for (int k = 0; k < ROWS; k++)
            for (int64_t j = 0; j < count; j++) state[j * rows + row[k]] = states[j][k / LANES][k % LANES];
    }
    leave(mode);
}
