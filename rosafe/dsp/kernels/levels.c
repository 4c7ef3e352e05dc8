/* The interaural level difference: energies of windowed frames, and the ratio of the ears' in dB (rosafe/dsp/ild.py). */
#include "frames.h"

#include <math.h>
#include <string.h>

/* The samples of a row are the `held` ones of `history` and the n of `block` behind them; rows of the history lie
 * history_stride apart. Samples from tail_from on, which are all of the block, go to `tail`, which may be where the history
 * was. The first frame begins at `skip`, each next one `hop` later. The rows are the left ear's channels, then the right
 * ear's; sums is (rows, whole + begun): first the frames that are complete, then those that have begun behind them. Where
 * `known` is not 0, `begun` holds the latter ones of the call before, rows begun_stride apart, which lack no sample of the
 * history; else all is summed. levels is (rows / 2, whole) with 10 log10((right + epsilon) / (left + epsilon)). */
void rosafe_levels(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                   double *tail, int64_t tail_stride, int64_t tail_from, int64_t rows, int64_t skip,
                   const double *weights, int64_t size, int64_t hop, int64_t whole, int64_t number, const double *begun,
                   int64_t begun_stride, int64_t known, double *sums, double epsilon, double *levels) {
    const framing frames = {skip, weights, size, hop, number};
    uint32_t mode = denormals_off();
    for (int64_t row = 0; row < rows; row++) {
        begin_sums(begun + row * begun_stride, known, number, sums + row * number);
        if (!known) add_frames(BOUNDED | SQUARED, history + row * history_stride, 0, held, &frames, sums + row * number);
        add_frames(BOUNDED | SQUARED, block + row * n, held, n, &frames, sums + row * number);
        memcpy(tail + row * tail_stride, block + row * n + (tail_from - held), (held + n - tail_from) * sizeof(double));
    }
    for (int64_t left = 0, right = rows / 2; right < rows; left++, right++)
        for (int64_t f = 0; f < whole; f++)
            levels[left * whole + f] =
                10 * log10((sums[right * number + f] + epsilon) / (sums[left * number + f] + epsilon));
    denormals_as(mode);
}
