/* Solves with supernodal Cholesky factors by CHOLMOD, packed for them.

   A factor of some thousand unknowns is read from memory in every solve, and that is most of what a
   solve takes. CHOLMOD keeps each supernode as a rectangle, of whose first rows half are zeros, and
   calls BLAS for it. Here it is kept as panels of at most WIDE columns, which are read one after the
   other:

     - the lower triangle of the panel's first rows, column by column, the diagonal inverted;
     - blocks of LANES rows, in each of them the columns one after the other;
     - a block of the rows that are left.

   A vector of LANES numbers are as many rows for one right-hand side, and as many right-hand sides
   where there are several. */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if __has_include(<suitesparse/cholmod.h>)
#include <suitesparse/cholmod.h>
#else
#include <cholmod.h>
#endif

#define WIDE 4
#define AHEAD 768 /* numbers that are fetched before they are used: 6 kB */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
#define LESS(a, b) ((a) < (b) ? (a) : (b))
#define INLINE static inline __attribute__((always_inline))

typedef double Lanes __attribute__((vector_size(8 * LANES), aligned(8)));

typedef struct {
  cholmod_factor *L; /* the supernodes; their numbers are packed */
  double *packed;
} Factor;

INLINE void fetch(const double *l, int wide)
{
  for (int i = 0; i < wide * LANES; i += 8)
    __builtin_prefetch(l + i);
}

/* Lv = b for the panel's columns; the rows below less what they are multiplied with */
INLINE const double *forward(const double *l, int wide, int rows, double *v)
{
  double x[WIDE];
  for (int c = 0; c < wide; c++)
    x[c] = v[c];
  for (int c = 0; c < wide; c++) {
    v[c] = x[c] *= *l++;
    for (int d = c + 1; d < wide; d++)
      x[d] -= *l++ * x[c];
  }
  int left = rows - wide;
  for (v += wide; left >= LANES; left -= LANES, v += LANES, l += wide * LANES) {
    fetch(l + AHEAD, wide);
    Lanes sum = *(Lanes *)v;
    for (int c = 0; c < wide; c++)
      sum -= *(const Lanes *)(l + c * LANES) * x[c];
    *(Lanes *)v = sum;
  }
  for (int c = 0; c < wide; c++)
    for (int i = 0; i < left; i++)
      v[i] -= *l++ * x[c];
  return l;
}

/* L'v = b for the panel's columns, the rows below known; `l` is the end of the panel */
INLINE const double *backward(const double *l, int wide, int rows, double *v)
{
  int left = (rows - wide) % LANES;
  double x[WIDE], *y = v + rows - left;
  Lanes sum[WIDE];
  l -= wide * left;
  for (int c = 0; c < wide; c++) {
    sum[c] = (Lanes){0.0};
    x[c] = v[c];
    for (int i = 0; i < left; i++)
      x[c] -= l[c * left + i] * y[i];
  }
  for (y -= LANES; y >= v + wide; y -= LANES) {
    l -= wide * LANES;
    fetch(l - AHEAD, wide);
    Lanes u = *(const Lanes *)y;
    for (int c = 0; c < wide; c++)
      sum[c] += *(const Lanes *)(l + c * LANES) * u;
  }
  for (int c = wide - 1; c >= 0; c--) {
    for (int i = 0; i < LANES; i++)
      x[c] -= sum[c][i];
    for (int d = wide - 1; d > c; d--)
      x[c] -= *--l * v[d];
    v[c] = x[c] * *--l;
  }
  return l;
}

/* the same two for LANES right-hand sides */
INLINE const double *forward_lanes(const double *l, int wide, int rows, Lanes *v)
{
  Lanes x[WIDE];
  for (int c = 0; c < wide; c++)
    x[c] = v[c];
  for (int c = 0; c < wide; c++) {
    v[c] = x[c] *= *l++;
    for (int d = c + 1; d < wide; d++)
      x[d] -= *l++ * x[c];
  }
  v += wide;
  for (int left = rows - wide, block; left > 0; left -= block, l += wide * block) {
    block = LESS(left, LANES);
    for (int i = 0; i < block; i++, v++) {
      Lanes sum = *v;
      for (int c = 0; c < wide; c++)
        sum -= l[c * block + i] * x[c];
      *v = sum;
    }
  }
  return l;
}

INLINE const double *backward_lanes(const double *l, int wide, int rows, Lanes *v)
{
  Lanes x[WIDE], *y = v + rows;
  for (int c = 0; c < wide; c++)
    x[c] = v[c];
  for (int left = rows - wide, block; left > 0; left -= block) {
    block = left % LANES ? left % LANES : LANES;
    y -= block, l -= wide * block;
    for (int i = 0; i < block; i++)
      for (int c = 0; c < wide; c++)
        x[c] -= l[c * block + i] * y[i];
  }
  for (int c = wide - 1; c >= 0; c--) {
    for (int d = wide - 1; d > c; d--)
      x[c] -= *--l * v[d];
    v[c] = x[c] * *--l;
  }
  return l;
}

/* a panel whose width is a constant: the compiler leaves no loops over its columns */
#define PANEL(SWEEP, wide)                                                                         \
  ((wide) == 4 ? SWEEP(l, 4, rows - j, v + j) : (wide) == 3 ? SWEEP(l, 3, rows - j, v + j)         \
   : (wide) == 2 ? SWEEP(l, 2, rows - j, v + j) : SWEEP(l, 1, rows - j, v + j))

/* LL'x = b in the order of the factor, in place; `v` has room for the rows of a supernode */
#define SOLVE(NAME, T, FORWARD, BACKWARD)                                                          \
  static void NAME(const Factor *F, T *x, T *v)                                                    \
  {                                                                                                \
    const int *column = F->L->super, *start = F->L->pi, *row = F->L->s, N = F->L->nsuper;          \
    const double *l = F->packed;                                                                   \
    for (int s = 0; s < N; s++) {                                                                  \
      int first = column[s], columns = column[s + 1] - first, rows = start[s + 1] - start[s];      \
      memcpy(v, x + first, columns * sizeof(T));                                                   \
      memset(v + columns, 0, (rows - columns) * sizeof(T));                                        \
      for (int j = 0; j < columns; j += WIDE)                                                      \
        l = PANEL(FORWARD, LESS(columns - j, WIDE));                                               \
      memcpy(x + first, v, columns * sizeof(T));                                                   \
      for (int i = columns; i < rows; i++)                                                         \
        x[row[start[s] + i]] += v[i];                                                              \
    }                                                                                              \
    for (int s = N - 1; s >= 0; s--) {                                                             \
      int first = column[s], columns = column[s + 1] - first, rows = start[s + 1] - start[s];      \
      for (int i = 0; i < rows; i++)                                                               \
        v[i] = x[row[start[s] + i]];                                                               \
      for (int j = (columns - 1) / WIDE * WIDE; j >= 0; j -= WIDE)                                 \
        l = PANEL(BACKWARD, LESS(columns - j, WIDE));                                              \
      memcpy(x + first, v, columns * sizeof(T));                                                   \
    }                                                                                              \
  }
SOLVE(solve_one, double, forward, backward)
SOLVE(solve_lanes, Lanes, forward_lanes, backward_lanes)

/* Parts u (k, size) of the solutions for right-hand sides f (k, size) that are zero but at the
   places (size,); a row f of zeros has none. `x` has room for LANES (n + longest) numbers. */
void supernodal_solve(const Factor *F, int size, const int *place, int k, const double *f,
                      double *u, double *x)
{
  size_t n = F->L->n;
  for (int r = 0; r < k;) {
    size_t lane[LANES], lanes = 0, stride;
    for (; r < k && lanes < LANES; r++) {
      size_t begin = (size_t)r * size, i = begin;
      while (i < begin + size && f[i] == 0.0)
        i++;
      if (i < begin + size)
        lane[lanes++] = begin;
      else
        memset(u + begin, 0, size * sizeof(double));
    }
    if (!lanes)
      continue;
    stride = lanes == 1 ? 1 : LANES;
    memset(x, 0, stride * n * sizeof(double));
    for (size_t c = 0; c < lanes; c++)
      for (int i = 0; i < size; i++)
        x[stride * place[i] + c] = f[lane[c] + i];
    if (lanes == 1)
      solve_one(F, x, x + n);
    else
      solve_lanes(F, (Lanes *)x, (Lanes *)x + n);
    for (size_t c = 0; c < lanes; c++)
      for (int i = 0; i < size; i++)
        u[lane[c] + i] = x[stride * place[i] + c];
  }
}

/* the panels of one of CHOLMOD's rectangles */
static double *pack(double *l, const double *x, size_t columns, size_t rows)
{
  for (size_t j = 0, wide; j < columns; j += wide) {
    wide = LESS(columns - j, WIDE);
    for (size_t c = j; c < j + wide; c++) {
      *l++ = 1.0 / x[c * rows + c];
      for (size_t d = c + 1; d < j + wide; d++)
        *l++ = x[c * rows + d];
    }
    for (size_t i = j + wide, block; i < rows; i += block) {
      block = LESS(rows - i, LANES);
      for (size_t c = j; c < j + wide; c++, l += block)
        if (block == LANES)
          *(Lanes *)l = *(const Lanes *)(x + c * rows + i);
        else
          memcpy(l, x + c * rows + i, block * sizeof(double));
    }
  }
  return l;
}

/* Pack a numeric factor, whose own numbers are given back; `sizes` are entries and longest. */
static int pack_all(Factor *F, long *sizes, cholmod_common *common)
{
  const int *column = F->L->super, *start = F->L->pi, *place = F->L->px, N = F->L->nsuper;
  for (int s = 0; s < N; s++) {
    long columns = column[s + 1] - column[s], rows = start[s + 1] - start[s];
    sizes[0] += columns * rows - columns * (columns - 1) / 2;
    sizes[1] = rows > sizes[1] ? rows : sizes[1];
  }
  double *l = F->packed = malloc(sizes[0] * sizeof(double));
  for (int s = 0; l && s < N; s++)
    l = pack(l, (double *)F->L->x + place[s], column[s + 1] - column[s], start[s + 1] - start[s]);
  return l && cholmod_change_factor(CHOLMOD_PATTERN, 1, 1, 1, 1, F->L, common);
}

void supernodal_free(Factor *F)
{
  cholmod_common common;
  cholmod_start(&common);
  cholmod_free_factor(&F->L, &common);
  cholmod_finish(&common);
  free(F->packed);
  free(F);
}

/* An ordering (n,) of the unknowns by one of their nodes, which have `width` unknowns each. */
static int order(const cholmod_sparse *A, int width, int *ordering, cholmod_common *common)
{
  int n = A->nrow, nodes = 0, count = 0, *from = A->p, *column = A->i;
  int *start = malloc(((size_t)n + 1 + from[n]) * sizeof(int)), *index = start + n + 1;
  if (!start)
    return 0;
  for (int i = 0; i < n; i += width) {
    start[nodes++] = count;
    for (int q = from[i]; q < from[i + 1]; q++)
      if (column[q] % width == 0)
        index[count++] = column[q] / width;
  }
  start[nodes] = count;
  cholmod_sparse graph = *A;
  graph.nrow = graph.ncol = nodes, graph.nzmax = count, graph.p = start, graph.i = index;
  graph.xtype = CHOLMOD_PATTERN, graph.x = NULL;
  cholmod_factor *L = cholmod_analyze(&graph, common);
  for (int k = count = 0; L && k < nodes; k++)
    for (int i = width * ((int *)L->Perm)[k], c = 0; c < width && i + c < n; c++)
      ordering[count++] = i + c;
  cholmod_free_factor(&L, common);
  free(start);
  return count == n;
}

/* The symbolic factor of a given ordering. Solves read the zeros of merged supernodes too, in panels
   that small supernodes fill as well: fewer zeros than CHOLMOD's choice for its dense kernels. Those
   of supernodes of up to 8, 24 and 64 columns make the factor 2 % larger, and a fifth faster. */
static cholmod_factor *analyse(cholmod_sparse *A, int *ordering, cholmod_common *common)
{
  common->nrelax[0] = 8, common->nrelax[1] = 24, common->nrelax[2] = 64;
  common->zrelax[0] = 0.1, common->zrelax[1] = 0.05, common->zrelax[2] = 0.02;
  common->nmethods = 1, common->method[0].ordering = CHOLMOD_GIVEN;
  common->supernodal = CHOLMOD_SUPERNODAL, common->final_ll = 1;
  return cholmod_analyze_p(A, ordering, NULL, 0, common);
}

/* The unknown that moves most in a displacement x of negative energy: -A^{-1}a and 1, where the pivot
   of the column a, after those of the definite matrix A, is not positive. */
static int weakest(const cholmod_factor *L, double *x)
{
  const int *column = L->super, *start = L->pi, *row = L->s, *place = L->px, k = L->minor;
  int most = k;
  memset(x, 0, L->n * sizeof(double));
  x[k] = 1.0;
  for (int s = L->nsuper - 1; s >= 0; s--)
    for (int c = LESS(column[s + 1], k) - 1; c >= column[s]; c--) {
      int first = c - column[s], rows = start[s + 1] - start[s];
      const double *l = (double *)L->x + place[s] + (size_t)first * rows;
      for (int i = first + 1; i < rows; i++)
        x[c] -= l[i] * x[row[start[s] + i]];
      x[c] /= l[first];
      most = fabs(x[c]) > fabs(x[most]) ? c : most;
    }
  return ((int *)L->Perm)[most];
}

/* Increase the diagonal entry of an unknown. */
static void hold(cholmod_sparse *A, int unknown, double spring)
{
  int q = ((int *)A->p)[unknown];
  while (((int *)A->i)[q] != unknown)
    q++;
  ((double *)A->x)[q] += spring;
}

/* The numeric factor. The diagonal entries of `*count` unknowns that are `held` are increased, in the
   matrix itself, by `spring`, and at most `more` times that of another one where a pivot is not
   positive; these are added to `held`. */
static int factorize(cholmod_sparse *A, cholmod_factor *L, double spring, int *held, int *count,
                     int more, cholmod_common *common)
{
  double *x = malloc(A->nrow * sizeof(double));
  for (int i = 0; i < *count; i++)
    hold(A, held[i], spring);
  while (x && cholmod_factorize(A, L, common) && L->minor < L->n && more--) {
    held[*count] = weakest(L, x);
    hold(A, held[(*count)++], spring);
  }
  free(x);
  return x && common->status >= CHOLMOD_OK && L->minor == L->n;
}

/* The factor of a symmetric matrix with both triangles and sorted rows, and the place (n,) of each
   unknown in it; NULL if the matrix is not positive definite with the springs, see above, or without
   memory: `sizes` has 1 or 0 first then. The ordering (n,) is that of a similar matrix if it leads to at most `*most` entries; else
   it is found, and `*most` becomes the number of entries. */
Factor *supernodal_factor(int n, int *start, int *index, double *value, int width, int methods,
                          double *most, int *ordering, int *place, long *sizes, double spring,
                          int *held, int *count, int more)
{
  cholmod_sparse A = {.nrow = n, .ncol = n, .nzmax = start[n], .p = start, .i = index, .x = value,
                      .stype = 1, .itype = CHOLMOD_INT, .xtype = CHOLMOD_REAL,
                      .dtype = CHOLMOD_DOUBLE, .sorted = 1, .packed = 1};
  Factor *F = calloc(1, sizeof(Factor));
  int done = 0;
  cholmod_common common;
  cholmod_start(&common);
  common.print = 0;
  if (F && *most > 0.0)
    F->L = analyse(&A, ordering, &common);
  if (F && F->L && common.lnz > *most)
    cholmod_free_factor(&F->L, &common);
  if (F && !F->L) {
    common.nmethods = methods, common.supernodal = CHOLMOD_SIMPLICIAL;
    if (order(&A, width, ordering, &common))
      F->L = analyse(&A, ordering, &common);
    *most = common.lnz;
  }
  done = F && F->L && factorize(&A, F->L, spring, held, count, more, &common) &&
         pack_all(F, sizes, &common);
  for (int i = 0; done && i < n; i++)
    place[((int *)F->L->Perm)[i]] = i;
  cholmod_finish(&common);
  if (!done)
    sizes[0] = F && F->L && F->L->minor < F->L->n;
  if (!done && F)
    supernodal_free(F);
  return done ? F : NULL;
}

/* whether the library is the one whose declarations were compiled */
int supernodal_is_usable(void)
{
  int version[3];
  return cholmod_version(version) == CHOLMOD_VERSION;
}
