/* Blocks of frames into their place in the whole, row by row. */

#include <stdint.h>
#include <string.h>

/* Each of the `blocks` has `rows` rows, of its own of the `lengths`, one behind the other; those of `whole` lie `stride`
   apart. */
void rosafe_join(int64_t count, const double *const *blocks, const int64_t *lengths, int64_t rows, double *whole,
                 int64_t stride)
{
    for (int64_t row = 0; row < rows; row++) {
        double *to = whole + row * stride;
        for (int64_t block = 0; block < count; block++) {
            const int64_t length = lengths[block];
            const double *from = blocks[block] + row * length;
            if (length < 32)
                for (int64_t i = 0; i < length; i++) /* a call for each of these would take longer */
                    to[i] = from[i];
            else
                memcpy(to, from, length * sizeof *to);
            to += length;
        }
    }
}
