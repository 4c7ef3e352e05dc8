/* The interaural level difference: energies of windowed frames, and the ratio of the ears' in dB (rosafe/dsp/ild.py). */
#include "frames.h"

#include <math.h>
#include <string.h>

/* The samples of a row are the `held` ones of `history` and the n of `block` behind them; rows of the history lie
 * history_stride apart. Samples from tail_from on, which are all of the block, go to `tail`, which may be where the history
 * was. The first frame begins at `skip`, each next one `hop` later, and `number` of them are complete. The rows are the left
 * ear's channels, then the right ear's. levels is (rows / 2, number) with 10 log10((right + epsilon) / (left + epsilon));
 * in `energies` is room for (rows, number). */
void rosafe_levels(const double *history, int64_t history_stride, int64_t held, const double *block, int64_t n,
                   double *tail, int64_t tail_stride, int64_t tail_from, int64_t rows, int64_t skip,
                   const double *weights, int64_t size, int64_t hop, int64_t number, double epsilon, double *energies,
                   double *levels) {
    const framing frames = {skip, weights, size, hop, number};
    uint32_t mode = denormals_off();
    memset(energies, 0, rows * number * sizeof(double));
    for (int64_t row = 0; row < rows; row++) {
        add_frames(BOUNDED | SQUARED, history + row * history_stride, 0, held, &frames, energies + row * number);
        add_frames(BOUNDED | SQUARED, block + row * n, held, n, &frames, energies + row * number);
        memcpy(tail + row * tail_stride, block + row * n + (tail_from - held), (held + n - tail_from) * sizeof(double));
    }
    const double *left = energies, *right = energies + rows / 2 * number;
    for (int64_t i = 0; i < rows / 2 * number; i++) levels[i] = 10 * log10((right[i] + epsilon) / (left[i] + epsilon));
    denormals_as(mode);
}
