/* Cross-correlation of the two ears' frames over few lags, in the time domain.
 *
 * c[m] = sum_t l[t+m] r[t] for m from -reach to reach, over sqrt(sum l^2 sum r^2 + eps) (rosafe/dsp/crosscorrelation.py).
 * A frame, of any channel, in each lane.
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
#include "vector.h"

#include <string.h>

enum {
    SPAN = 1024,        /* samples of a frame at a time: all of this stays in the second-level cache */
    MOST_LAGS = 1024,   /* FFT is faster beyond */
    MOST_HALVINGS = 3,
    MOST_PHASES = 1 << MOST_HALVINGS,
    LAGS_AT_ONCE = LANES == 8 ? 25 : 13, /* of 32 or 16 registers */
    LONGEST = SPAN + MOST_LAGS + MOST_PHASES * (MOST_HALVINGS + 2),
};

/* --- products --- */

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

/* The same of sequences in 2^halvings phases: r and c with n and `lags` elements in each, l with n + lags - 1 + halvings. */
static void product(int halvings, const vec *const *l, const vec *const *r, int64_t n, int64_t lags, vec *const *c,
                    vec *scratch) {
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

/* How often to halve: where the work is least, counted in fused multiplications and additions that need no store. */
static int best_halvings(int64_t size, int64_t lags) {
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

/* --- frames --- */

/* Samples in 2^halvings phases, `length` in each. */
typedef struct {
    vec *samples;
    int64_t halvings, length;
} phases;

INLINE vec *at(phases to, int64_t t) {
    return to.samples + (t & ((1 << to.halvings) - 1)) * to.length + (t >> to.halvings);
}

/* Samples from..until of the rows times `window` to `to` from t on; returns their energy. */
static vec put(const double *const rows[LANES], const double *window, int64_t from, int64_t until, phases to, int64_t t) {
    vec energy = {}, *place[MOST_PHASES]; /* of eight samples in turn; those of the next eight lie `advance` further */
    for (int k = 0; k < MOST_PHASES; k++) place[k] = at(to, t + k);
    int64_t i = from, advance = MOST_PHASES >> to.halvings, ahead = 0;
    for (; i + MOST_PHASES <= until; i += MOST_PHASES, ahead += advance)
        UNROLL for (int k = 0; k < MOST_PHASES; k += 2) {
            vec pair[2];
            read_pair(rows, i + k, pair);
            UNROLL for (int j = 0; j < 2; j++) {
                vec x = bounded(pair[j], -LIMIT, LIMIT) * all(window[i + k + j]);
                energy = fused(x, x, energy);
                place[k + j][ahead] = x;
            }
        }
    for (int k = 0; i + k < until; k++) {
        vec x = bounded(gathered(rows, i + k), -LIMIT, LIMIT) * all(window[i + k]);
        energy = fused(x, x, energy);
        place[k][ahead] = x;
    }
    return energy;
}

static void put_zeros(phases to, int64_t t, int64_t until) {
    for (; t < until; t++) *at(to, t) = (vec){};
}

/* Where the samples of each lane's frame are: those before the border in the history, the others in the block. */
typedef struct {
    const double *old[LANES], *new[LANES];
    int64_t border;
} frames;

/* As `put`. */
INLINE vec put_both(const frames *of, const double *window, int64_t from, int64_t until, phases to, int64_t t) {
    const int64_t middle = most(from, least(until, of->border));
    vec energy = put(of->old, window, from, middle, to, t);
    return energy + put(of->new, window, middle, until, to, t + middle - from);
}

/* Samples from..until of frames that begin at different samples are joined: their borders lie apart. */
static void join(frames *of, const int64_t starts[LANES], int64_t held, int64_t from, int64_t until,
                 double joined[LANES][LONGEST]) {
    for (int k = 0; k < LANES; k++) {
        int64_t middle = most(from, least(until, held - starts[k]));
        memcpy(joined[k], of->old[k] + from, (middle - from) * sizeof(double));
        memcpy(joined[k] + middle - from, of->new[k] + middle, (until - middle) * sizeof(double));
        of->new[k] = joined[k] - from;
    }
    of->border = from;
}

/* The samples of a row are the `held` ones of `history` and the n of `block` behind them; the first frame begins at `skip`,
 * each next one `hop` later. Rows are (2, channels); those of the history lie history_stride apart. Samples from tail_from
 * on, which are all of the block, go to `tail`, which may be where the history was. output is (channels, 2 reach + 1,
 * frames), the channels channel_stride apart. 2 reach + 1 is at most MOST_LAGS. */
void rosafe_correlations(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                         double *tail, int64_t tail_stride, int64_t tail_from, int64_t channels, int64_t skip,
                         const double *window, int64_t size, int64_t hop, int64_t number, int64_t reach, double epsilon,
                         double *output, int64_t channel_stride) {
    uint32_t mode = denormals_off();
    const int64_t lags = 2 * reach + 1, spans = (size + SPAN - 1) / SPAN, span = (size + spans - 1) / spans;
    const int halvings = best_halvings(span, lags);
    const int64_t count = 1 << halvings, n_r = (span + count - 1) / count, n_c = (lags + count - 1) / count;
    const int64_t n_l = n_r + n_c - 1 + halvings;
    vec l_samples[LONGEST], r_samples[SPAN + MOST_PHASES], c_samples[MOST_LAGS + MOST_PHASES], scratch[3 * LONGEST];
    const phases l = {l_samples, halvings, n_l}, r = {r_samples, halvings, n_r}, c = {c_samples, halvings, n_c};
    const vec *l_phases[MOST_PHASES], *r_phases[MOST_PHASES];
    vec *c_phases[MOST_PHASES];
    for (int i = 0; i < count; i++)
        l_phases[i] = l_samples + i * n_l, r_phases[i] = r_samples + i * n_r, c_phases[i] = c_samples + i * n_c;

    for (int64_t first = 0; first < channels * number; first += LANES) {
        vec correlation[MOST_LAGS], energy[2] = {};
        double *to[LANES];
        int64_t channel[LANES], start[LANES];
        for (int64_t m = 0; m < lags; m++) correlation[m] = (vec){};
        for (int k = 0; k < LANES; k++) { /* lanes without a frame do the last one once more */
            int64_t which = least(first + k, channels * number - 1);
            channel[k] = which % channels;
            start[k] = skip + which / channels * hop;
            to[k] = output + channel[k] * channel_stride + which / channels;
        }
        for (int64_t begin = 0; begin < size; begin += span) {
            /* r from `begin` to `end`; of l, up to `reach` more on either side */
            int64_t end = least(begin + span, size), l_begin = most(0, begin - reach), l_end = least(size, end + reach);
            for (int ear = 0; ear < 2; ear++) {
                double joined[LANES][LONGEST];
                frames mine = {.border = held - start[0]};
                for (int k = 0; k < LANES; k++) {
                    int64_t row = ear * channels + channel[k];
                    mine.old[k] = history + row * history_stride + start[k];
                    mine.new[k] = block + row * n + start[k] - held;
                }
                if (start[0] != start[LANES - 1])
                    join(&mine, start, held, ear ? begin : l_begin, ear ? end : l_end, joined);
                if (ear == 0) {
                    put_zeros(l, 0, reach - (begin - l_begin));
                    put_both(&mine, window, l_begin, begin, l, reach - (begin - l_begin));
                    energy[0] += put_both(&mine, window, begin, end, l, reach);
                    put_both(&mine, window, end, l_end, l, reach + end - begin);
                    put_zeros(l, reach + l_end - begin, count * n_l);
                } else {
                    energy[1] += put_both(&mine, window, begin, end, r, 0);
                    put_zeros(r, end - begin, count * n_r);
                }
            }
            product(halvings, l_phases, r_phases, n_r, n_c, c_phases, scratch);
            for (int64_t m = 0; m < lags; m++) correlation[m] += *at(c, m);
        }
        vec scale = all(1.0) / root(energy[0] * energy[1] + all(epsilon));
        for (int64_t m = 0; m < lags; m++) {
            vec normalised = correlation[m] * scale;
            UNROLL for (int k = 0; k < LANES; k++) to[k][m * number] = normalised[k];
        }
    }
    for (int64_t i = 0; i < 2 * channels; i++)
        memcpy(tail + i * tail_stride, block + i * n + (tail_from - held), (held + n - tail_from) * sizeof(double));
    denormals_as(mode);
}
