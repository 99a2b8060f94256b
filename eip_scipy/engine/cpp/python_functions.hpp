// A user's functions in Python, called with arrays of their own, as SciPy calls them.
#pragma once

#include "python.hpp"

#include <optional>
#include <vector>

#include "system.hpp"

namespace eip {

// One function: fun(t, y[, f][, out], *args). What it returns is taken as it is where it is an array of the right kind,
// or a float; else `convert(value, t)` makes that of it,
// or raises.
class PythonCall {
  public:
    // `description` has the attributes fun, args, convert, shape (of the value: () for a number), takes_f, in_place.
    PythonCall(PyObject *description, int type, int64_t components, PyObject *kept);

    // y has `components` of the state's type; f too, where the function takes it. `owner`: the array that `out` lies in.
    void operator()(double t, const double *y, const double *f, double *out, PyObject *owner) const;

    int64_t floats() const { return floats_; }

  private:
    bool takes_list(PyObject *value) const;
    void take(PyObject *value, PyObject *t, double *out) const;

    PyObject *fun_, *convert_;
    std::vector<PyObject *> args_;
    npy_intp dimensions_[2];
    int n_dimensions_, type_, value_type_;
    int64_t components_, floats_;
    bool takes_f_, in_place_;
};

// The functions of a run.
class PythonFunctions final : public Functions {
  public:
    // `functions` has rhs, and sequences inv, grad and event; `work` the arrays that functions in place fill.
    PythonFunctions(PyObject *functions, PyObject *work, const Work &sizes, int type, PyObject *kept);

    void rhs(double t, const double *y, double *out) override;
    void inv(double t, const double *y, double *values) override;
    void grad(double t, const double *y, const double *f, double *G) override;
    void event(double t, const double *y, double *values) override;
    void jacobian(double t, const double *q, const double *dq, double *out) override;
    bool has_jacobian() const { return jacobian_.has_value(); }
    int64_t events() const { return static_cast<int64_t>(event_.size()); }

    // More arrays that functions in place fill.
    void add_buffers(PyObject *work, PyObject *kept);

  private:
    struct Owner {
        const double *first, *last;
        PyObject *array;
    };
    PyObject *owner_of(const double *out) const;

    std::optional<PythonCall> rhs_, jacobian_;
    std::vector<PythonCall> inv_, grad_, event_;
    std::vector<Owner> owners_;
    int64_t m_;
    bool second_order_;
};

// Parts of a step in Python, see `Hooks` in native.py.
class PythonHooks final : public Hooks {
  public:
    PythonHooks(PyObject *hooks, PyObject *work, const Run &run, int type, PyObject *kept);

    int raw_step(const Step &step) override;
    int finish_step(const Step &step) override;
    bool project_jointly(const Step &step) override;
    int project_elsewhere(const Step &step) override;
    bool all_agree(bool here) override;

    // The array that the steps to come lead to.
    void set_state(PyObject *to) { to_ = to; }

  private:
    Run run_;
    int type_;
    PyObject *to_ = nullptr;
    PyObject *one_step_ = nullptr, *finish_ = nullptr, *project_ = nullptr, *agree_ = nullptr, *moments_ = nullptr,
             *shift_ = nullptr;
    PyObject *y_hat_ = nullptr, *f_hat_ = nullptr, *values_ = nullptr, *R_ = nullptr, *terms_ = nullptr, *mu_ = nullptr;
    bool estimates_ = false;
};

}  // namespace eip
