/* Spectral features: fourteen numbers of the spectrum of each frame; formulas in rosafe/representations/spectralfeatures.py.
 *
 * Frames are processed one after the other, as there are few; in numpy, most of the time is the overhead of the many sums. */
#include <math.h>
#include <stdint.h>

#define E 1e-15 /* added to denominators and arguments of logarithms */

enum { CENTROID, CREST, SPREAD, ENTROPY, BRIGHTNESS, HFC, DECREASE, FLATNESS, FLUX, KURTOSIS, SKEWNESS, IRREGULARITY,
       ROLLOFF, VARIATION, FEATURES };

typedef struct {
    double *x, *levels; /* of each channel, and 10 log10(x + E) */
    double norm;        /* sqrt(sum x^2) + E */
} spectrum;

static void take(const double *rates, int64_t step, int64_t channels, spectrum *of) {
    double squares = 0.0;
    for (int64_t c = 0; c < channels; c++) {
        of->x[c] = rates[c * step];
        of->levels[c] = 10 * log10(of->x[c] + E);
        squares += of->x[c] * of->x[c];
    }
    of->norm = sqrt(squares) + E;
}

/* The frequency below which the sum reaches `threshold`. */
static double rolloff(const double *x, const double *frequencies, double threshold) {
    double below = 0.0, above = x[0];
    int64_t c = 0;
    while (above < threshold) {
        below = above;
        above += x[++c];
    }
    if (c == 0) return frequencies[0];
    return frequencies[c - 1] + (threshold - below) / (above - below) * (frequencies[c] - frequencies[c - 1]);
}

static void describe(const spectrum *now, const spectrum *before, int64_t channels, const double *frequencies,
                     double highest, double bright, double part, double *features, int64_t step) {
    const double *x = now->x;
    const double others = channels > 1 ? channels - 1 : 1;
    double sum = 0.0, largest = 0.0, first = 0.0, second = 0.0, brightness = 0.0, slope = 0.0, logarithms = 0.0;
    double flux = 0.0, irregularity = 0.0, product = 0.0;
    int silent = 0; /* whether any channel is silent */
    for (int64_t c = 0; c < channels; c++) {
        sum += x[c];
        largest = fmax(largest, x[c]);
        first += frequencies[c] * x[c];
        second += frequencies[c] * frequencies[c] * x[c];
        if (frequencies[c] > bright) brightness += x[c];
        if (x[c] > 0)
            logarithms += log(x[c]);
        else
            silent = 1;
        double change = now->levels[c] - before->levels[c];
        flux += change * change;
        product += x[c] * before->x[c];
        if (c > 0) {
            double difference = now->levels[c] - now->levels[c - 1];
            irregularity += difference * difference;
            slope += (x[c] - x[0]) / c;
        }
    }
    const double total = sum + E, mean = sum / channels, center = first / total;
    double spread = 0.0, entropy = 0.0, squares = 0.0;
    for (int64_t c = 0; c < channels; c++) {
        double distance = frequencies[c] - center, share = x[c] / total, deviation = x[c] - mean;
        spread += distance * distance * x[c];
        entropy -= share * log(share + E);
        squares += deviation * deviation;
    }
    const double deviation = sqrt(squares / others) + E;
    double third = 0.0, fourth = 0.0, rest = 0.0;
    for (int64_t c = 0; c < channels; c++) {
        double z = (x[c] - mean) / deviation;
        third += z * z * z;
        fourth += z * z * z * z;
        if (c > 0) rest += x[c];
    }
    features[CENTROID * step] = center / highest;
    features[CREST * step] = largest / (mean + E);
    features[SPREAD * step] = sqrt(spread / total) / highest;
    features[ENTROPY * step] = channels > 1 ? entropy / log(channels) : 0.0;
    features[BRIGHTNESS * step] = brightness / total;
    features[HFC * step] = second / total;
    features[DECREASE * step] = slope / (rest + E);
    features[FLATNESS * step] = silent ? 0.0 : exp(logarithms / channels) / (mean + E);
    features[FLUX * step] = sqrt(flux / channels);
    features[KURTOSIS * step] = fourth / channels - 3;
    features[SKEWNESS * step] = third / channels;
    features[IRREGULARITY * step] = sqrt(irregularity / others);
    features[ROLLOFF * step] = sum > 0 ? rolloff(x, frequencies, part * sum) / highest : 0.0;
    features[VARIATION * step] = 1 - product / (now->norm * before->norm);
}

/* spectra is (rows, channels, n), `last` (rows, channels) the previous frame; none of them is negative. features is (rows,
 * FEATURES, n); work is a buffer of (4, channels). */
void rosafe_spectral_features(const double *spectra, const double *last, int64_t rows, int64_t channels, int64_t n,
                              const double *frequencies, double bright, double part, double *work, double *features) {
    double highest = 0.0;
    for (int64_t c = 0; c < channels; c++) highest = fmax(highest, frequencies[c]);
    for (int64_t row = 0; row < rows; row++) {
        spectrum before = {work, work + channels, 0.0}, now = {work + 2 * channels, work + 3 * channels, 0.0};
        take(last + row * channels, 1, channels, &before);
        for (int64_t f = 0; f < n; f++) {
            take(spectra + row * channels * n + f, n, channels, &now);
            describe(&now, &before, channels, frequencies, highest, bright, part, features + row * FEATURES * n + f, n);
            spectrum oldest = before;
            before = now;
            now = oldest;
        }
    }
}
