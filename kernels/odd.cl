/* The odd pass of a transform, in registers. */

#define MAX_ODD 9

/* x <- sum_j x_j exp(sign 2 pi i j k / n), k = 0 .. n - 1, n odd. With s_j = x_j + x_(n - j) and
 * d_j = x_j - x_(n - j), numbers k and n - k are
 *     x_0 + sum_j cos(2 pi j k / n) s_j  +-  i sign sum_j sin(2 pi j k / n) d_j,  0 < j <= n / 2.
 * roots: [n][2], cosine and sine of 2 pi k / n.
 */
INLINE void dft_odd(cvec *x, const int n, const real sign, __global const real *roots)
{
    const cvec first = x[0];
    cvec sums[MAX_ODD / 2 + 1], differences[MAX_ODD / 2 + 1];
    UNROLL
    for (int j = 1; j <= n / 2; ++j) {
        sums[j] = add(x[j], x[n - j]);
        differences[j] = subtract(x[j], x[n - j]);
        x[0] = add(x[0], sums[j]);
    }
    UNROLL
    for (int k = 1; k <= n / 2; ++k) {
        cvec even = first, odd = {0, 0};
        UNROLL
        for (int j = 1; j <= n / 2; ++j) {
            const real cosine = roots[2 * (j * k % n)], sine = sign * roots[2 * (j * k % n) + 1];
            even = add(even, times(sums[j], cosine));
            odd = add(odd, times(differences[j], sine));
        }
        x[k] = add(even, times_i(odd));
        x[n - k] = subtract(even, times_i(odd));
    }
}
