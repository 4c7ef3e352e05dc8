/* The interaural level difference: energies of windowed frames, and the ratio of the ears' in dB (rosafe/dsp/ild.py). */
#include "frames.h"

#include <math.h>

/* The rows are the left ear's channels, then the right ear's. levels is (rows / 2, number) with
 * 10 log10((right + epsilon) / (left + epsilon)); in `energies` is room for (rows, number). */
void rosafe_levels(const framed *of, double epsilon, double *energies, double *levels) {
    const int64_t rows = of->rows, number = of->number, held = of->held, n = of->n;
    uint32_t mode = enter();
    for (int64_t row = 0; row < rows; row++) {
        for (int64_t frame = 0, at = of->skip; frame < number; frame++, at += of->hop) {
            const halves mine = {of->history + row * of->history_stride + at, of->block + row * n + at - held, held - at};
            energies[row * number + frame] = weighted(BOUNDED | SQUARED, &mine, of->weights, of->size);
        }
        keep_tail(of, row);
    }
    const double *left = energies, *right = energies + rows / 2 * number;
    for (int64_t i = 0; i < rows / 2 * number; i++) levels[i] = 10 * log10((right[i] + epsilon) / (left[i] + epsilon));
    leave(mode);
}
