/* Complex arithmetic on vectors of LANES numbers, real and imaginary parts apart. */

typedef struct {
    vec re, im;
} cvec;

/* One complex number, of one lane. */
typedef struct {
    real re, im;
} scalar;

/* A vector of the reals from p on, which need not lie where vectors do. */
#if LANES == 1
#define LOAD_UNALIGNED(p) (*(p))
#else
typedef vec unaligned_vec __attribute__((aligned(sizeof(real))));
#define LOAD_UNALIGNED(p) (*(__global const unaligned_vec *)(p))
#endif

/* Point i of a block; x is already at this work-item's vector of the block. */
#define LOAD(x, i) ((cvec){(x)[2 * (i) * SIDE], (x)[(2 * (i) + 1) * SIDE]})
/* Where butterfly x of the outer pass has its first point, in the lines that begin at p. */
#define FROM_POINT(p, x, lane) ((p) + 2 * (x) * SIDE + (lane))
/* The same of a map, or its one point where that holds for all; a product would take registers. */
#define LOAD_MAP(x, has_map, i) LOAD(x, (i) & -(has_map))
#define STORE(x, i, value)                      \
    do {                                        \
        (x)[2 * (i) * SIDE] = (value).re;       \
        (x)[(2 * (i) + 1) * SIDE] = (value).im; \
    } while (0)

INLINE cvec add(const cvec a, const cvec b)
{
    return (cvec){a.re + b.re, a.im + b.im};
}

INLINE cvec subtract(const cvec a, const cvec b)
{
    return (cvec){a.re - b.re, a.im - b.im};
}

INLINE cvec times(const cvec a, const real factor)
{
    return (cvec){a.re * factor, a.im * factor};
}

INLINE cvec multiply(const cvec a, const cvec b)
{
    return (cvec){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

INLINE cvec multiply_conjugate(const cvec a, const cvec b) /* a conj(b) */
{
    return (cvec){a.re * b.re + a.im * b.im, a.im * b.re - a.re * b.im};
}

/* The same with one scalar root of unity for all lanes. */
INLINE cvec rotate(const cvec a, const real re, const real im)
{
    return (cvec){a.re * re - a.im * im, a.re * im + a.im * re};
}

INLINE cvec times_i(const cvec a)
{
    return (cvec){-a.im, a.re};
}

INLINE cvec times_minus_i(const cvec a)
{
    return (cvec){a.im, -a.re};
}
