/* The ratemap: a leaky integrator, then sums over moving windows of its output or the square of that.
 *
 * u[t] = s + (1 - r) x[t], s = r u[t] (rosafe/dsp/ratemap.py). Neighbouring samples are in the lanes: the sums of one, two,
 * four... samples up to each lane's own are made in as many steps (as in parallel prefix sums, W. D. Hillis and
 * G. L. Steele (1986), Communications of the ACM 29), and what came before the register is added with the powers of r.
 *
 * Samples go in spans that stay in the first-level cache, and each frame that touches a span adds its part of it. So every
 * sample is read once, and of what is integrated only the tail that is kept goes to memory. */
#include "frames.h"


enum { SPAN = 2048 };

typedef struct {
    double retention;
    vec gain;          /* 1 - r */
    vec powers;        /* r to the power of 0, 1, 2... */
    vec doubled[STEPS]; /* r to the power of 1, 2, 4... */
    vec whole;         /* r to the power of LANES */
} integrator;

static integrator design(double retention) {
    integrator made = {.retention = retention, .gain = all(1.0 - retention)};
    double power = 1.0;
    for (int k = 0; k < LANES; k++, power *= retention) made.powers[k] = power;
    made.whole = all(power);
    UNROLL for (int i = 0; i < STEPS; i++) made.doubled[i] = all(made.powers[1 << i]);
    return made;
}

/* u of n samples and of what lies up to LANES - 1 places behind; given s before the first one, returns that behind the last. */
INLINE double integrate(const integrator *by, const double *x, int64_t n, double s, double *u) {
    vec before = all(s), now = {};
    for (int64_t t = 0; t < n; t += LANES) {
        vec sum = t + LANES <= n ? load(x + t) : load_first(x + t, n - t);
        sum = bounded(sum, -LIMIT, LIMIT) * by->gain;
        UNROLL for (int i = 0; i < STEPS; i++) sum = fused(by->doubled[i], delayed(sum, i), sum);
        now = fused(by->powers, before, sum);
        before = fused(by->whole, before, all(by->retention) * last(sum));
        *(vec_anywhere *)(u + t) = now;
    }
    return by->retention * u[n - 1];
}

INLINE void run(const int how, const double *history, int64_t held, const double *block, int64_t n, double *tail,
                int64_t tail_from, const framed *frames, const integrator *by, double *state, double *sums) {
    double span[SPAN + LANES], s = *state;
    add_frames(how, history, 0, held, frames, sums);
    for (int64_t at = held, end; at < held + n; at = end) {
        end = least(at + SPAN, held + n);
        s = integrate(by, block + at - held, end - at, s, span);
        add_frames(how, span, at, end - at, frames, sums);
        int64_t from = most(at, tail_from);
        if (from < end) memcpy(tail + from - tail_from, span + from - at, (end - from) * sizeof(double));
    }
    *state = flushed(s);
}

/* The history has been integrated already, the block has not. state is (rows, 2), of which the second belongs to the twin's
 * form; rates (rows, number). */
void rosafe_ratemap(const framed *of, int64_t squared, double retention, double *state, double *rates) {
    const int64_t rows = of->rows, number = of->number, held = of->held, n = of->n;
    const integrator by = design(retention);
    uint32_t mode = enter();
    memset(rates, 0, rows * number * sizeof(double));
    for (int64_t row = 0; row < rows; row++) {
        const double *old = of->history + row * of->history_stride, *new = of->block + row * n;
        double *kept = of->tail + row * of->tail_stride;
        if (squared)
            run(SQUARED, old, held, new, n, kept, of->tail_from, of, &by, state + 2 * row, rates + row * number);
        else
            run(0, old, held, new, n, kept, of->tail_from, of, &by, state + 2 * row, rates + row * number);
    }
    leave(mode);
}
