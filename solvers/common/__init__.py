"""What solvers share: conversion of QPs, sequences of them, and lists of backends."""
